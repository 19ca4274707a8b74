"""The cameras that a run's data come from: kept with its weights, so that the exported model knows its rig.

A preset names KITTI's rig. Data of another baseline (or, for presets that crop from the top, of another focal length
at network size) make another model: its depths hold for that rig alone, and the runtime says so.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

from safetensors import SafetensorError, safe_open

from edge.detector.presets import Preset
from runtime.contracts.errors import CheckpointError, RigError
from runtime.contracts.manifest import RigLimits
from runtime.preprocess import network_view
from runtime.rig import SILENT_SHARE, TOLERATED_SHARE
from runtime.sources.base import FrameSequence

RIG_KEY = "rig"  # of the metadata of weights


def with_rig_of_data(preset: Preset, sources: Sequence[FrameSequence]) -> Preset:
    """The preset with the rig of the data's first frames; as it is where that is the preset's within 5 %.

    Args:
        preset: to train.
        sources: its data; those without frames do not count.

    Raises:
        RigError: the data come from rigs so different that no one model can serve them.
    """
    rigs = [_network_rig(source, preset) for source in sources if len(source)]
    if not rigs:
        return preset
    for rig in rigs[1:]:
        if _difference(rig, rigs[0], stereo=preset.views == 2) > TOLERATED_SHARE:
            raise RigError(
                f"data have baselines of {rigs[0].baseline_m:.3g} m and {rig.baseline_m:.3g} m, network focal lengths"
                f" of {rigs[0].focal_px:.4g} px and {rig.focal_px:.4g} px, expected one rig within"
                f" {TOLERATED_SHARE:.0%}; train a model for each rig"
            )
    if _difference(rigs[0], preset.rig, stereo=preset.views == 2) <= SILENT_SHARE:
        return preset
    return replace(preset, rig=rigs[0])


def rig_metadata(preset: Preset) -> dict[str, str]:
    """What weights of this preset say of their rig."""
    return {RIG_KEY: json.dumps(asdict(preset.rig))}


def with_rig_of(preset: Preset, weights: Path) -> Preset:
    """The preset with the rig that a weights file of ``edge train`` names; as it is where the file names none.

    Raises:
        CheckpointError: what it names is no rig.
    """
    if weights.suffix != ".safetensors":
        return preset
    try:
        with safe_open(weights, framework="numpy") as file:
            text = (file.metadata() or {}).get(RIG_KEY)
        return preset if text is None else replace(preset, rig=_parsed(text))
    except (SafetensorError, OSError, ValueError, TypeError, KeyError) as error:
        raise CheckpointError(
            f"{weights} names its rig wrongly ({type(error).__name__}), expected focal_px and baseline_m; train it anew"
        ) from None


def _parsed(text: str) -> RigLimits:
    values = json.loads(text)
    focal_px, baseline_m = float(values["focal_px"]), float(values["baseline_m"])
    if not (focal_px > 0.0 and baseline_m > 0.0):
        raise ValueError(text)
    return RigLimits(focal_px, baseline_m)


def _network_rig(source: FrameSequence, preset: Preset) -> RigLimits:
    seen = network_view(source[0].geometry, preset.manifest()).geometry
    fixed = preset.crop.mode == "above_horizon"  # scaled to the preset's focal length, whatever the camera's
    return RigLimits(preset.rig.focal_px if fixed else seen.focal_px, seen.baseline_m)


def _difference(rig: RigLimits, other: RigLimits, *, stereo: bool) -> float:
    """The larger relative difference of focal length and, for stereo, baseline."""
    focal = abs(rig.focal_px / other.focal_px - 1.0)
    return max(focal, abs(rig.baseline_m / other.baseline_m - 1.0)) if stereo else focal
