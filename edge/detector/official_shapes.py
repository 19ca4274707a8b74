"""Depth, widths and class count of an official checkpoint, read from the shapes of its tensors.

Every layer of a part votes with its number of output channels, so that one odd tensor does not change what the part is
taken for: it is then named as the one that does not fit.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

import torch

from edge.detector.backbone import LAYOUT_BY_DEPTH
from edge.detector.blocks import Bottleneck
from edge.detector.build import build_detector
from edge.detector.checkpoint_file import Checkpoint
from edge.detector.misfit import compare, shapes_of
from edge.detector.presets import HeadShape, NeckShape, NetworkShape, Preset
from runtime.boxcode import DELTA_COUNT
from runtime.contracts.errors import CheckpointError


def fitted_preset(preset: Preset, checkpoint: Checkpoint, classes: tuple[str, ...] | None = None) -> Preset:
    """The preset with depth, widths and class count of an official checkpoint.

    Args:
        preset: what the checkpoint is said to be; kept as it is where all of it fits, or for weights of our own.
        checkpoint: the file's content.
        classes: names in channel order, for a checkpoint with another count of classes than the preset.

    Raises:
        CheckpointError: names or shapes that fit neither; other anchors than the preset's; no names for the classes.
    """
    if classes is not None and (len(set(classes)) != len(classes) or not all(classes)):
        raise CheckpointError(
            f"classes are {', '.join(map(repr, classes))}, expected each name once; name them as Car,Pedestrian"
        )
    named = preset if classes is None else replace(preset, classes=classes)
    if not checkpoint.official:
        return named
    as_named = compare(expected_shapes(named), checkpoint)
    if not as_named:
        return named
    reader = _Reader(checkpoint)
    found = reader.preset(named)
    as_found = compare(expected_shapes(found), checkpoint)
    if not as_found:
        return found
    reader.check_anchors_and_classes(named)
    raise min(as_named, as_found, key=len).error()


def class_count(preset: Preset, checkpoint: Checkpoint) -> int:
    """How many classes an official checkpoint tells apart, by the channels of its last class layer and its anchors."""
    channels = _Reader(checkpoint).channels("classification.6") if checkpoint.official else None
    if channels is None or channels % preset.anchors.per_cell:
        return len(preset.classes)
    return channels // preset.anchors.per_cell - 1


def expected_shapes(preset: Preset) -> dict[str, tuple[int, ...]]:
    """Shapes by name of a preset's network; nothing is allocated."""
    with torch.device("meta"):
        return shapes_of(build_detector(preset).state_dict())


class _Reader:
    """Reads sizes off one checkpoint; where it says nothing, those of a preset stay."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self._checkpoint = checkpoint
        self._shapes = shapes_of(checkpoint.state)

    def preset(self, base: Preset) -> Preset:
        """Another preset's numbers replaced by those that the tensors show."""
        depth, widths = self._backbone(base.network)
        neck = None if base.network.neck is None else self._neck(base.network.neck)
        head = self._head(base.network.head)
        network = replace(base.network, backbone_depth=depth, backbone_widths=widths, neck=neck, head=head)
        return replace(base, network=network)

    def _width(self, pattern: str, otherwise: int) -> int:
        """Output channels that most tensors whose name begins so have."""
        begins = re.compile(pattern)
        votes = Counter(shape[0] for name, shape in self._shapes.items() if shape and begins.match(name))
        return votes.most_common(1)[0][0] if votes else otherwise

    def _backbone(self, base: NetworkShape) -> tuple[int, tuple[int, int, int]]:
        counts = tuple(_count(self._numbers(rf"backbone\.layer{stage}\.(\d+)\.")) for stage in (1, 2, 3))
        deep = any(re.match(r"backbone\.layer1\.\d+\.conv3\.", name) for name in self._shapes)
        by_layout = {(block is Bottleneck, numbers): depth for depth, (block, numbers) in LAYOUT_BY_DEPTH.items()}
        if not any(counts):
            return base.backbone_depth, base.backbone_widths
        if (deep, counts) not in by_layout:
            raise CheckpointError(
                f"{self._checkpoint.path} has {', '.join(map(str, counts))} {'bottlenecks' if deep else 'basic blocks'}"
                f" in core.backbone.layer1 to layer3, expected a ResNet of depth {_listed(LAYOUT_BY_DEPTH)}; "
                "give a checkpoint of such a backbone"
            )
        first, second, third = (
            self._width(rf"backbone\.layer{stage}\.\d+\.(conv|bn)[12]\.", base.backbone_widths[stage - 1])
            for stage in (1, 2, 3)
        )
        return by_layout[deep, counts], (first, second, third)

    def _numbers(self, pattern: str) -> set[int]:
        found = (re.match(pattern, name) for name in self._shapes)
        return {int(match[1]) for match in found if match}

    def _neck(self, base: NeckShape) -> NeckShape:
        at_4 = self._width(r"neck\.four_to_eight\.ghost\.", base.disparities_at_4)
        width_at_8 = self._width(r"neck\.four_to_eight\.block\.", base.width_at_8)
        joined_at_8 = self._width(r"neck\.eight_to_sixteen\.ghost\.", width_at_8 + base.disparities_at_8)
        width_at_16 = self._width(r"neck\.eight_to_sixteen\.block\.", base.width_at_16)
        features = self._width(r"neck\.concat_volume\.", base.concat_features)
        joined_at_16 = self._width(r"neck\.sixteen\.ghost\.", width_at_16 + features * base.concat_shifts)
        return replace(
            base,
            disparities_at_4=at_4,
            disparities_at_8=max(joined_at_8 - width_at_8, 1),
            concat_features=features,
            concat_shifts=max((joined_at_16 - width_at_16) // max(features, 1), 1),
            width_at_8=width_at_8,
            width_at_16=width_at_16,
            out_channels=self._width(r"neck\.sixteen\.block\.", base.out_channels),
            disparity_widths=(
                self._width(r"disparity_branch\.layers\.[12]\.", base.disparity_widths[0]),
                self._width(r"disparity_branch\.layers\.[56]\.", base.disparity_widths[1]),
            ),
            disparity_classes=self._width(r"disparity_branch\.layers\.8\.", base.disparity_classes),
        )

    def _head(self, base: HeadShape) -> HeadShape:
        box_width = self._width(r"head\.regression\.[01]\.", base.box_width or 0)
        return replace(
            base,
            class_width=self._width(r"head\.classification\.[03]\.", base.class_width),
            box_width=box_width or None,
            class_final_kernel=self._kernel("head.classification.6.weight", base.class_final_kernel),
            box_final_kernel=self._kernel("head.regression.3.weight", base.box_final_kernel),
        )

    def _kernel(self, name: str, missing: int) -> int:
        shape = self._shapes.get(name, ())
        return shape[-1] if len(shape) == 4 else missing

    def check_anchors_and_classes(self, base: Preset) -> None:
        """Refuses other anchors, or another count of classes, than a preset's, where the last layers agree on them."""
        anchors = base.anchors.per_cell
        last_box = "regression.6" if base.network.head.deformable else "regression.3"
        found = self.channels(last_box)
        if found not in (None, anchors * DELTA_COUNT):
            raise CheckpointError(
                f"{self._checkpoint.path} has {found} channels in {self._last(last_box)}, expected {DELTA_COUNT}"
                f" for each of the {anchors} anchors of a cell; choose the --preset with the checkpoint's anchors"
            )
        logits = self.channels("classification.6")
        expected = anchors * (len(base.classes) + 1)
        if logits is not None and logits != expected and logits % anchors == 0:
            raise CheckpointError(
                f"{self._checkpoint.path} has {logits} channels in {self._last('classification.6')}: "
                f"{logits // anchors - 1} classes, expected {expected}: {len(base.classes)} "
                f"({', '.join(base.classes)}); name its classes in their order by --classes"
            )

    def channels(self, layer: str) -> int | None:
        """Output channels of a last layer, if weight and bias agree."""
        found = {shape[0] for name, shape in self._shapes.items() if shape and name.startswith(f"head.{layer}.")}
        return found.pop() if len(found) == 1 else None

    def _last(self, layer: str) -> str:
        return self._checkpoint.name_in_file(f"head.{layer}.weight")


def _count(numbers: set[int]) -> int:
    return max(numbers) + 1 if numbers else 0


def _listed(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))
