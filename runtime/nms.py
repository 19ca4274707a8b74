"""Greedy non-maximum suppression of 2D boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray


def iou_one_to_many(box: FloatArray, boxes: FloatArray) -> FloatArray:
    """Intersection over union of one xyxy box with (N, 4) others."""
    width = np.minimum(box[2], boxes[:, 2]) - np.maximum(box[0], boxes[:, 0])
    height = np.minimum(box[3], boxes[:, 3]) - np.maximum(box[1], boxes[:, 1])
    overlap = np.maximum(width, 0.0) * np.maximum(height, 0.0)
    areas = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    union = (box[2] - box[0]) * (box[3] - box[1]) + areas - overlap
    iou: FloatArray = np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)
    return iou


def non_maximum_suppression(
    boxes: FloatArray,
    scores: FloatArray,
    iou: float,
    *,
    groups: NDArray[np.int64] | None = None,
    depths: FloatArray | None = None,
    depth_share: float = 0.0,
) -> NDArray[np.int64]:
    """Keep the best box of every cluster.

    Args:
        boxes: (N, 4) xyxy.
        scores: (N,).
        iou: boxes that overlap a kept one by more than this are dropped.
        groups: (N,) class of each box: only boxes of the same group suppress each other; None: all together.
        depths: (N,) metres: boxes of different groups suppress each other, too, where their depths differ by
            less than ``depth_share`` of the kept one's.

    Returns:
        Indices of the kept boxes, by falling score (ties: lower index first).
    """
    order = np.argsort(-scores, kind="stable")
    ranked = np.asfortranarray(boxes[order])  # each coordinate contiguous: the inner loop is over columns
    group = None if groups is None else groups[order]
    depth = None if depths is None else depths[order]
    alive = np.ones(len(order), dtype=bool)
    for rank in range(len(order)):
        if not alive[rank]:
            continue
        suppressed = iou_one_to_many(ranked[rank], ranked[rank + 1 :]) > iou
        if group is not None:
            rivals = group[rank + 1 :] == group[rank]
            if depth is not None:
                rivals |= np.abs(depth[rank + 1 :] - depth[rank]) < depth_share * depth[rank]
            suppressed &= rivals
        alive[rank + 1 :] &= ~suppressed
    kept: NDArray[np.int64] = order[alive]
    return kept
