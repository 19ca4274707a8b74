"""The rows of the paper's ablation table as changes of a preset (paper, section V-A, table IV).

Each name sets the fields that its row is about and nothing else; several can be combined. A detector trained with one
has to be exported with it, too: the model directory's preset then bears its name.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from edge.detector.presets import NeckShape, Preset, PresetError


def _neck(**fields: Any) -> Callable[[Preset], Preset]:
    def change(preset: Preset) -> Preset:
        neck: NeckShape | None = preset.network.neck
        if neck is None:
            raise PresetError(
                f"preset {preset.name} has no stereo neck, expected one for this ablation; choose compact or paper"
            )
        return replace(preset, network=replace(preset.network, neck=replace(neck, **fields)))

    return change


def _anchors(**fields: Any) -> Callable[[Preset], Preset]:
    return lambda preset: replace(preset, anchors=replace(preset.anchors, **fields))


def _training(**fields: Any) -> Callable[[Preset], Preset]:
    return lambda preset: replace(preset, training=replace(preset.training, **fields))


ABLATIONS: dict[str, Callable[[Preset], Preset]] = {
    "no-anchor-prior": _anchors(depth_by_prior=False),
    "no-anchor-filter": _anchors(filter_by_ground=False),
    "no-channel-expansion": _neck(expansion="none"),
    "naive-channel-expansion": _neck(expansion="naive"),
    "no-scale-8": _neck(scale_8=False),
    "no-scale-16": _neck(scale_16=False),
    "no-disparity-supervision": _training(disparity_source="none"),
    "point-supervision": _training(disparity_source="points"),
}


def ablated(preset: Preset, names: Sequence[str]) -> Preset:
    """The preset with the named ablations, which its name then tells.

    Raises:
        PresetError: an unknown name, or one that changes a part that the preset does not have.
    """
    for name in names:
        if name not in ABLATIONS:
            raise PresetError(f"ablation is {name!r}, expected one of {', '.join(ABLATIONS)}; choose one of these")
        preset = ABLATIONS[name](preset)
        preset = replace(preset, name=f"{preset.name}+{name}")
    return preset
