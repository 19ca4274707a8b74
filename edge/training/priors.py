"""Statistical priors: what depth, angle and size an anchor's shape suggests (paper, section III-A1).

Every anchor of the image that overlaps an object by more than one half adds the z, sin 2a, cos 2a of the object that
it overlaps best to the statistics of its shape; sizes have one mean and deviation a class. Official rules: occlusion
below 2, z above 3 m; shapes with fewer than ten samples, or a deviation below 1e-3, are unusable (mean -100,
deviation 1e10).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from edge.training.assign import pairwise_iou
from runtime.anchors import AnchorGrid, BoolArray, anchor_grid
from runtime.contracts.geometry import FloatArray
from runtime.contracts.manifest import UNUSABLE_MEAN, UNUSABLE_STD, AnchorLayout, AnchorPriors
from runtime.contracts.objects import Objects3D

MIN_SAMPLES = 10
MIN_DEVIATION = 1e-3
MIN_DEPTH_M = 3.0
MAX_OCCLUSION = 1
OVERLAP = 0.5


class PriorStatistics:
    """Accumulates one class's samples by anchor shape."""

    def __init__(self, shape_count: int) -> None:
        self._count = np.zeros(shape_count)
        self._sum = np.zeros((shape_count, 3))
        self._square = np.zeros((shape_count, 3))
        self._sizes: list[FloatArray] = []

    def add_frame(self, objects: Objects3D, boxes: FloatArray, grid: AnchorGrid) -> None:
        """Add one frame's objects of the class: every anchor lends its shape to the object it overlaps best."""
        self._sizes.append(objects.size_hwl[:, [1, 0, 2]])
        double = 2 * objects.alpha_rad
        quantities = np.stack([objects.center_in_camera[:, 2], np.sin(double), np.cos(double)], axis=1)
        near = np.flatnonzero(_centre_in_any(grid, boxes))
        iou = pairwise_iou(grid.boxes[near], boxes.astype(np.float32))
        overlapping = iou.max(axis=1) > OVERLAP
        anchors = near[overlapping]
        samples = quantities[iou[overlapping].argmax(axis=1)]
        shapes = grid.shape_index[anchors]
        np.add.at(self._count, shapes, 1)
        np.add.at(self._sum, shapes, samples)
        np.add.at(self._square, shapes, samples**2)

    def tables(self) -> tuple[FloatArray, FloatArray]:
        """Mean and deviation, (shapes, 6) each; the 6 = z, sin 2a, cos 2a, w, h, l."""
        count = len(self._count)
        mean, std = np.full((count, 6), UNUSABLE_MEAN), np.full((count, 6), UNUSABLE_STD)
        with np.errstate(invalid="ignore", divide="ignore"):
            average = self._sum / self._count[:, None]
            deviation = np.sqrt(self._square / self._count[:, None] - average**2)
        usable = (self._count[:, None] >= MIN_SAMPLES) & (deviation >= MIN_DEVIATION)  # False where not a number
        mean[:, :3] = np.where(usable, average, UNUSABLE_MEAN)
        std[:, :3] = np.where(usable, deviation, UNUSABLE_STD)
        if self._sizes:
            sizes = np.concatenate(self._sizes)
            mean[:, 3:] = sizes.mean(axis=0)
            std[:, 3:] = np.maximum(sizes.std(axis=0), MIN_DEVIATION)  # of one object, seen often, too
        return mean, std


def _centre_in_any(grid: AnchorGrid, boxes: FloatArray) -> BoolArray:
    """(N,) bool: anchors with their centre in one of the boxes (M, 4); none else covers half of itself with a box."""
    found = np.zeros(len(grid.boxes), bool)
    for left, top, right, bottom in boxes + np.array([-1, -1, 1, 1]):  # a pixel's margin for rounding
        x, y = grid.center_xy.T
        found |= (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
    return found


def anchor_statistics(
    frames: Iterable[tuple[Objects3D, FloatArray]],
    classes: tuple[str, ...],
    layout: AnchorLayout,
    *,
    input_size_hw: tuple[int, int],
) -> AnchorPriors:
    """Priors from labelled frames.

    Args:
        frames: objects of each frame and their 2D boxes (N, 4) in network pixels.
        classes: the preset's classes.
        layout: anchor shapes.
        input_size_hw: network image.
    """
    grid = anchor_grid(layout, input_size_hw)
    statistics = {name: PriorStatistics(layout.per_cell) for name in classes}
    for objects, boxes in frames:
        counted = (objects.occlusion <= MAX_OCCLUSION) & (objects.center_in_camera[:, 2] > MIN_DEPTH_M)
        for name in classes:
            rows = np.flatnonzero(counted & (objects.class_id == objects.class_names.index(name)))
            if rows.size:
                statistics[name].add_frame(objects.select(rows), boxes[rows], grid)
    tables = [statistics[name].tables() for name in classes]
    table_shape = (len(classes), len(layout.ratios), layout.scale_count, 6)
    mean, std = (np.array([t[part] for t in tables]).reshape(table_shape).swapaxes(1, 2) for part in (0, 1))
    return AnchorPriors(mean.astype(np.float32), std.astype(np.float32))
