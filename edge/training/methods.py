"""The paper's way of training and the official code's, as two sets of options for any preset.

Where the two differ the paper's set follows the text, and the official set repeats the code, its flaws included, so
that a run can be compared with published figures. Weights of loss terms (depth 12, classes 20 and 40) are in both: the
paper gives none. A preset as it stands follows neither to the letter; ``docs/departures.md`` names its choices.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from safetensors import safe_open

from edge.detector.presets import Preset, PresetError

PAPER: MappingProxyType[str, Any] = MappingProxyType(
    {
        "epochs": 50,
        "dead_zones": False,
        "empty_images_teach": True,
        "claim_without_overlap": False,
        "disparity_focal": 5.0,
        "disparity_valid_only": True,
        "mirrored_disparity": "matched",
        "matching_grey": "plain",
    }
)
OFFICIAL: MappingProxyType[str, Any] = MappingProxyType(
    {
        "epochs": 80,
        "dead_zones": True,
        "empty_images_teach": False,
        "claim_without_overlap": True,
        "disparity_focal": 0.0,
        "disparity_valid_only": False,
        "mirrored_disparity": "official",
        "matching_grey": "official",
    }
)
METHOD_KEY = "method"  # of the metadata of weights
METHODS = MappingProxyType({"paper": PAPER, "official": OFFICIAL})
FILTERS_BY_CLASS = MappingProxyType({"paper": True, "official": False})


def with_method(preset: Preset, name: str) -> Preset:
    """The preset with a method's options: those of training, and the anchor filter, which the model keeps.

    Raises:
        PresetError: no method of that name.
    """
    if name not in METHODS:
        raise PresetError(f"method is {name!r}, expected one of {', '.join(METHODS)}; choose one of these")
    return replace(
        preset,
        training=replace(preset.training, **METHODS[name]),
        anchors=replace(preset.anchors, filter_by_class=FILTERS_BY_CLASS[name]),
    )


def with_method_of(preset: Preset, weights: Path) -> Preset:
    """The preset with the method that a weights file of ``edge train`` names; as it is where the file names none."""
    if weights.suffix != ".safetensors":
        return preset
    with safe_open(weights, framework="numpy") as file:
        name = (file.metadata() or {}).get(METHOD_KEY)
    return with_method(preset, name) if name in METHODS else preset
