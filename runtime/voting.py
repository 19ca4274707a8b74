"""Boxes that suppression drops say once more where the object is: what is kept becomes their weighted mean.

Neighbouring anchors on one object predict nearly the same box, and which of them scores highest hangs on the last
digits: 8 bits alone make suppression keep another one, whose place is a few centimetres off. The mean over all that
agree changes little with any of them (box voting: Gidaris and Komodakis, ICCV 2015, section 4.3; here for all numbers
of a 3D box).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.boxcode import ALPHA, X1, Y2, FloatArray32, Z
from runtime.nms import iou_one_to_many

LEAST_SCORE_SHARE: Final = 0.5
"""A box votes from this share of the kept box's score on: so votes do not depend on the threshold of the call."""
NEAR_DEPTH_SHARE: Final = 0.15
"""Boxes on one spot of the image whose depths differ by more are of two objects, one behind the other."""
NEAR_ANGLE_RAD: Final = 0.8
"""Boxes that face elsewhere have no say about the angle."""


def voted_boxes(
    boxes: FloatArray32, score: FloatArray32, class_id: NDArray[np.int64], keep: NDArray[np.int64], *, iou: float
) -> FloatArray32:
    """Kept boxes as means of the boxes that agree with them, weighted with the square of the score.

    Args:
        boxes: (N, 11) candidates, columns of `runtime.boxcode`, metres, radians and network pixels.
        score: (N,); class_id: (N,).
        keep: (M,) indices of the boxes that suppression keeps.
        iou: boxes of the same class that overlap a kept one by more in the image have a vote.

    Returns:
        (M, 11) float32. A box that nothing else agrees with is as it was.
    """
    result = boxes[keep].copy()
    for row, index in enumerate(keep):
        voters = np.flatnonzero((class_id == class_id[index]) & (score >= LEAST_SCORE_SHARE * score[index]))
        wide = boxes[voters].astype(np.float64)
        kept = boxes[index].astype(np.float64)
        agree = iou_one_to_many(kept[X1 : Y2 + 1], wide[:, X1 : Y2 + 1]) > iou
        with np.errstate(divide="ignore", invalid="ignore"):
            agree &= np.abs(wide[:, Z] / kept[Z] - 1.0) < NEAR_DEPTH_SHARE
        if np.count_nonzero(agree) < 2:
            continue
        wide, weight = wide[agree], score[voters[agree]].astype(np.float64) ** 2
        mean = weight @ wide / weight.sum()
        turn_rad = np.angle(np.exp(1j * (wide[:, ALPHA] - kept[ALPHA])))
        facing = np.abs(turn_rad) < NEAR_ANGLE_RAD
        mean[ALPHA] = kept[ALPHA] + weight[facing] @ turn_rad[facing] / weight[facing].sum()
        result[row] = mean.astype(np.float32)
    return result
