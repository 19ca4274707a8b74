"""What the float model shows on the calibration frames: equalised channels, statistics, shifts of biases.

Each step first looks in the cache for what an earlier run over the same frames saw.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass

import cv2
import numpy as np
import onnx
import onnxruntime

from calib.cache import cache_key, load, store
from calib.choice import DEFAULT_METHOD, Choice, choose
from calib.finder import ModelFinder
from calib.frames import CalibrationSet, frame_feeds, rig_check
from calib.methods import Range
from calib.ranges import Observation, Progress, no_progress, observe
from quantize.bias_correction import Shifts, bias_shifts
from quantize.equalise import equalisable, equalise
from quantize.prepare import Prepared
from quantize.qdq import Levels
from quantize.static import build
from runtime.contracts.frame import StereoFrame

_FLOAT_BYTES = 4
CORRECTION_FRAMES = 8
"""Frames that show bias correction its means, and equalisation its channels' peaks."""


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was seen on which frames.

    Attributes:
        frames: the record of the choice.
        observation: statistics by tensor.
        from_cache: whether the model had been run over these frames before.
    """

    frames: CalibrationSet
    observation: Observation
    from_cache: bool


def choose_frames(
    prepared: Prepared,
    source: Sequence[StereoFrame],
    wanted: int,
    *,
    name: str,
    method: str = DEFAULT_METHOD,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
    warn: Callable[[str], None] = lambda line: None,
) -> Choice:
    """Chooses the calibration frames of an entered source, once for all that runs over them.

    Args:
        prepared: The model.
        source: Calibration frames by index.
        wanted: How many of them.
        name: What the record calls the source.
        method: One of `calib.choice.METHODS`.
        use_cache: Look for, and keep, what frames show in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told how far the looking is.
        warn: Told in one line what is odd about the frames.

    Raises:
        SourceError: There are no frames.
        RigError, FrameError: A frame does not fit the model.
    """
    check = rig_check(prepared.source.manifest, allow_other_rig=allow_other_rig, warn=warn)
    with closing(ModelFinder(prepared.source, allow_other_rig=allow_other_rig)) as find:
        choice = choose(
            source,
            wanted,
            name=name,
            method=method,
            check=check,
            find=find,
            use_cache=use_cache,
            progress=progress,
            warn=warn,
        )
    available = choice.chosen.available
    if available < wanted:
        warn(f"calibration source: {available} frames, {wanted} were wanted; all are used")
    return choice


def calibrate(
    prepared: Prepared,
    choice: Choice,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Calibration:
    """Takes the statistics of all 8-bit tensors on the chosen frames.

    Args:
        prepared: The model.
        choice: Of `choose_frames`, its source still entered.
        use_cache: Look for, and keep, the statistics in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told how far it is.

    Raises:
        FrameError: A frame does not fit the model.
        FormatError: The float model gives values that are not finite.
    """
    manifest, placement = prepared.source.manifest, prepared.placement
    chosen = choice.chosen
    key = run_key(
        prepared,
        prepared.model,
        chosen,
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
    )
    known = load(key) if use_cache else None
    if known is not None:
        return Calibration(chosen, known, from_cache=True)
    observation = observe(
        prepared.model,
        lambda: frame_feeds(choice.frames(), manifest, allow_other_rig=allow_other_rig),
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
        bytes_of=tensor_bytes(prepared),
        frame_count=len(chosen.frames),
        progress=progress,
    )
    if use_cache:
        store(key, observation)
    return Calibration(chosen, observation, from_cache=False)


def equalised(
    prepared: Prepared,
    choice: Choice,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Prepared:
    """The same network with channels of like range; as it was where the recipe does not equalise.

    Comes before `calibrate`, which then sees the ranges of the new channels.

    Args:
        prepared: The float model.
        choice: Of `choose_frames`; its first few frames show how large channels get.
        use_cache: Look for, and keep, what they showed in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.

    Raises:
        FrameError, FormatError: As `calibrate`.
    """
    names = (
        equalisable(prepared.model, prepared.shapes, prepared.placement.observed) if prepared.recipe.equalise else []
    )
    if not names:
        return prepared
    manifest = prepared.source.manifest
    chosen = choice.chosen.first(CORRECTION_FRAMES)
    key = run_key(prepared, prepared.model, chosen, tensors=(), channel_tensors=names)
    seen = load(key) if use_cache else None
    if seen is None:
        seen = observe(
            prepared.model,
            lambda: frame_feeds(choice.frames(CORRECTION_FRAMES), manifest, allow_other_rig=allow_other_rig),
            tensors=(),
            channel_tensors=names,
            bytes_of=tensor_bytes(prepared),
            frame_count=len(chosen.frames),
            progress=lambda stage, done, total: progress("looking at channels", done, total),
        )
        if use_cache:
            store(key, seen)
    return dataclasses.replace(prepared, model=equalise(prepared.model, prepared.shapes, seen.channels))


def corrections(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    choice: Choice,
    *,
    levels: Levels | None = None,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Shifts:
    """What the biases take in addition on account of 8 bits; nothing where the recipe does not correct.

    Args:
        prepared: The float model.
        calibration: Of its whole placement.
        ranges: Of its tensors, those that the build will use.
        choice: Of `choose_frames`; its first few frames are run, since means settle soon.
        levels: Of the weights, that the build will use (`quantize.rounding`).
        use_cache: Look for, and keep, the result in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.
    """
    if not prepared.recipe.bias_correction:
        return {}
    graph = build(prepared, calibration.observation, ranges, levels=levels)
    few = calibration.frames.first(CORRECTION_FRAMES)
    key = run_key(prepared, graph.model, few, tensors=("bias shifts", str(CORRECTION_FRAMES)))
    seen = load(key) if use_cache else None
    if seen is not None:
        return {name: shift.astype(np.float64) for name, (shift, _) in seen.channels.items()}
    feeds = frame_feeds(choice.frames(CORRECTION_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig)
    found = bias_shifts(
        prepared.model, graph.model, prepared.placement, feeds, frame_count=CORRECTION_FRAMES, progress=progress
    )
    rounded = {name: shift.astype(np.float32) for name, shift in found.items()}
    if use_cache:
        store(key, Observation({}, {name: (shift, shift) for name, shift in rounded.items()}, CORRECTION_FRAMES))
    return {name: shift.astype(np.float64) for name, shift in rounded.items()}


def run_key(
    prepared: Prepared,
    model: onnx.ModelProto,
    frames: CalibrationSet,
    *,
    tensors: Sequence[str],
    channel_tensors: Sequence[str] = (),
) -> str:
    """Hash of all that a run over frames depends on."""
    manifest = prepared.source.manifest
    camera_view = (manifest.crop, manifest.input_size_hw, manifest.input_type, manifest.normalisation, manifest.rig)
    return cache_key(
        model.SerializeToString(deterministic=True),
        frames.digest,
        geometry_digest=frames.geometry_digest,
        tensors=tensors,
        channel_tensors=channel_tensors,
        view=repr((*camera_view, f"ONNX Runtime {onnxruntime.__version__}", f"OpenCV {cv2.__version__}")),
    )


def tensor_bytes(prepared: Prepared) -> dict[str, int]:
    """Size of each tensor of the graph in float32."""
    return {tensor: math.prod(shape) * _FLOAT_BYTES for tensor, shape in prepared.shapes.items()}
