"""Anchor boxes of the network image, and which of them can hold an object on the ground (paper, section III-A1).

NumPy alone: training, evaluation of priors and decoding share this file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray
from runtime.contracts.manifest import AnchorLayout, AnchorPriors

FloatArray32 = NDArray[np.float32]
BoolArray = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class AnchorGrid:
    """All anchors of one input size, ordered rows x columns x anchors a cell.

    Attributes:
        boxes: (N, 4) float32 xyxy in network pixels.
        center_xy: (N, 2) float32.
        size_wh: (N, 2) float32.
        shape_index: (N,) int64, index of the anchor within its cell (ratio-major).
    """

    boxes: FloatArray32
    center_xy: FloatArray32
    size_wh: FloatArray32
    shape_index: NDArray[np.int64]


def anchor_shapes(layout: AnchorLayout) -> FloatArray:
    """Width and height of a cell's anchors, (K, 2) float64, ratio-major."""
    sizes = layout.base_px * 2.0 ** (np.arange(layout.scale_count) / layout.scales_per_octave)
    roots = np.sqrt(np.array(layout.ratios))[:, None]
    return np.stack([(sizes[None] / roots).ravel(), (sizes[None] * roots).ravel()], axis=1)


def anchor_grid(layout: AnchorLayout, size_hw: tuple[int, int]) -> AnchorGrid:
    """Anchors centred in the cells of a network image of ``size_hw`` pixels."""
    shapes = anchor_shapes(layout)
    rows, columns = size_hw[0] // layout.stride_px, size_hw[1] // layout.stride_px
    y, x = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    centers = (np.stack([x, y], axis=-1).reshape(-1, 1, 2) + 0.5) * layout.stride_px
    lower, upper = centers - 0.5 * shapes[None], centers + 0.5 * shapes[None]
    boxes = np.concatenate([lower, upper], axis=-1).reshape(-1, 4).astype(np.float32)
    size_wh = boxes[:, 2:] - boxes[:, :2]
    return AnchorGrid(
        boxes=boxes,
        center_xy=boxes[:, :2] + np.float32(0.5) * size_wh,
        size_wh=size_wh,
        shape_index=np.tile(np.arange(len(shapes)), rows * columns),
    )


def usable_by_class(grid: AnchorGrid, layout: AnchorLayout, *, priors: AnchorPriors, P2: FloatArray) -> BoolArray:
    """Anchors whose centre lies near the ground plane at the mean depth of each class; all where the layout asks so.

    As the official code does it: both axes use fy, the translation column of P2 is left out, and unusable prior
    cells (z = -100) take part; they drop out where the prior itself is needed.

    Args:
        grid: anchors of the network image.
        layout: their layout, with the limits in metres.
        priors: (classes, scales, ratios, 6) tables.
        P2: (3, 4) of the network image.

    Returns:
        (classes, N) bool.
    """
    mean, _ = priors.by_anchor()
    if not layout.filter_by_ground:
        return np.ones((len(mean), len(grid.boxes)), bool)
    depth_m = mean[:, :, 0].astype(np.float64)[:, grid.shape_index]
    focal, column, row = P2[1, 1], P2[0, 2], P2[1, 2]
    x_m = (grid.center_xy[:, 0] - column) * depth_m / focal
    y_m = (grid.center_xy[:, 1] - row) * depth_m / focal
    near_ground: BoolArray = (y_m > layout.min_y_m) & (y_m < layout.max_y_m) & (np.abs(x_m) < layout.max_abs_x_m)
    return near_ground


def usable_anchors(grid: AnchorGrid, layout: AnchorLayout, *, priors: AnchorPriors, P2: FloatArray) -> BoolArray:
    """(N,) bool: anchors that `usable_by_class` keeps for any class."""
    usable: BoolArray = np.asarray(usable_by_class(grid, layout, priors=priors, P2=P2).any(axis=0))
    return usable
