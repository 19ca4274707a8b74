"""Greedy non-maximum suppression of 2D boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray


def iou_one_to_many(box: FloatArray, boxes: FloatArray) -> FloatArray:
    """Intersection over union of one xyxy box with (N, 4) others."""
    overlap_wh = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
    overlap = np.prod(np.maximum(overlap_wh, 0.0), axis=1)
    areas = np.prod(boxes[:, 2:] - boxes[:, :2], axis=1)
    union: FloatArray = np.prod(box[2:] - box[:2]) + areas - overlap
    iou: FloatArray = np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)
    return iou


def non_maximum_suppression(
    boxes: FloatArray, scores: FloatArray, iou: float, *, groups: NDArray[np.int64] | None = None
) -> NDArray[np.int64]:
    """Keep the best box of every cluster.

    Args:
        boxes: (N, 4) xyxy.
        scores: (N,).
        iou: boxes that overlap a kept one by more than this are dropped.
        groups: (N,) class of each box: only boxes of the same group suppress each other; None: all together.

    Returns:
        Indices of the kept boxes, by falling score (ties: lower index first).
    """
    order = np.argsort(-scores, kind="stable")
    kept: list[int] = []
    while order.size:
        best, rest = order[0], order[1:]
        kept.append(int(best))
        suppressed = iou_one_to_many(boxes[best], boxes[rest]) > iou
        if groups is not None:
            suppressed &= groups[rest] == groups[best]
        order = rest[~suppressed]
    return np.array(kept, dtype=np.int64)
