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
from runtime.contracts.geometry import FloatArray
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
    kept_class = class_id[keep]
    for kind in np.unique(kept_class):
        members = np.flatnonzero(class_id == kind)
        members = members[np.argsort(-score[members], kind="stable")]
        falling = score[members]
        rising = -falling
        ranked = np.asfortranarray(boxes[members], np.float64)  # voters are its first rows, each column in one piece
        for row in np.flatnonzero(kept_class == kind):
            kept = boxes[keep[row]].astype(np.float64)
            count = int(np.searchsorted(rising, -LEAST_SCORE_SHARE * score[keep[row]], side="right"))
            voters = ranked[:count]
            agree = iou_one_to_many(kept[X1 : Y2 + 1], voters[:, X1 : Y2 + 1]) > iou
            with np.errstate(divide="ignore", invalid="ignore"):
                agree &= np.abs(voters[:, Z] / kept[Z] - 1.0) < NEAR_DEPTH_SHARE
            if np.count_nonzero(agree) >= 2:
                result[row] = _mean_box(kept, voters[agree], falling[:count][agree].astype(np.float64) ** 2)
    return result


def _mean_box(kept: FloatArray, voters: FloatArray, weight: FloatArray) -> FloatArray32:
    """(11,) the weighted mean of (V, 11) voters; of the angle, only of those that face as the kept box does."""
    mean = weight @ voters / weight.sum()
    turn_rad = np.angle(np.exp(1j * (voters[:, ALPHA] - kept[ALPHA])))
    facing = np.abs(turn_rad) < NEAR_ANGLE_RAD
    mean[ALPHA] = kept[ALPHA] + weight[facing] @ turn_rad[facing] / weight[facing].sum()
    result: FloatArray32 = mean.astype(np.float32)
    return result
