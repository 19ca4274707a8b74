"""Calibrations of growing sets of frames, each the first part of the next, from one run over the largest."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing

from calib.choice import Choice
from calib.finder import ModelFinder
from calib.frames import frame_feeds, rig_check
from calib.pool import Pool, look_at
from calib.ranges import Progress, no_progress, observe_prefixes
from quantize.calibration import Calibration, tensor_bytes
from quantize.prepare import Prepared
from runtime.contracts.frame import StereoFrame


def looked_at(
    prepared: Prepared,
    source: Sequence[StereoFrame],
    wanted: int,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Pool:
    """The pool that a choice of up to ``wanted`` frames is made from; see `quantize.calibration.choose_frames`.

    Raises:
        SourceError: There are no frames.
        RigError, FrameError: A frame does not fit the model.
    """
    check = rig_check(prepared.source.manifest, allow_other_rig=allow_other_rig)
    with closing(ModelFinder(prepared.source, allow_other_rig=allow_other_rig)) as find:
        return look_at(source, wanted, check=check, find=find, use_cache=use_cache, progress=progress)


def observe_first(
    prepared: Prepared,
    choice: Choice,
    counts: Sequence[int],
    *,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> dict[int, Calibration]:
    """What calibration sees on the first few frames of a choice, for several numbers of frames, in one run.

    Args:
        prepared: The float model.
        choice: At least as many frames as the largest of ``counts``, or all that there are.
        counts: Numbers of frames.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.

    Returns:
        Calibration by number of frames, the whole choice among them.

    Raises:
        FrameError: A frame does not fit the model.
        FormatError: There was no frame, or the float model gives values that are not finite.
    """
    placement = prepared.placement
    seen = observe_prefixes(
        prepared.model,
        lambda: frame_feeds(choice.frames(), prepared.source.manifest, allow_other_rig=allow_other_rig),
        counts=counts,
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
        bytes_of=tensor_bytes(prepared),
        frame_count=len(choice.chosen.frames),
        progress=progress,
    )
    return {
        frames: Calibration(choice.chosen.first(frames), observation, from_cache=False)
        for frames, observation in sorted(seen.items())
    }
