"""The angle that makes the projected 3D box fit the 2D box (monocular post-processing of the official code).

One view says little about an angle but much about the 2D box. From ``theta = alpha + atan2(cx - c_x, f_x)`` the yaw
climbs: a step to either side is taken where it raises the IoU of the 2D box with the outline of the projected 3D box,
cut at the image; where neither side does, the step is halved. Nothing but the angle changes.

Two flaws of the official code are not kept: its image is 1280 x 288 whatever the network's, and it takes 6.28 for a
full turn in one direction, so that a box whose angle wraps is turned by 0.003 rad too little.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.boxcode import ALPHA, CX, CY, HEIGHT, LENGTH, WIDTH, X1, Y2, FloatArray32, Z
from runtime.contracts.geometry import FloatArray

FIRST_STEP_RAD: Final = 0.4
LAST_STEP_RAD: Final = 0.01
MIN_DEPTH_M: Final = 3.0
"""A nearer box reaches beyond the image, and its outline says nothing."""
CLIMBING_CLASS: Final = "Car"
"""The official code turns cars alone: the outline of a person hardly depends on the angle."""
DEPTH_GUARD_M: Final = 1e-6
_SIDE = np.array([-1, 1, 1, 1, 1, -1, -1, -1], np.float64)  # along the width
_UP = np.array([-1, -1, 1, 1, -1, -1, 1, 1], np.float64)
_AHEAD = np.array([-1, -1, -1, 1, 1, 1, 1, -1], np.float64)  # along the length


def climb(boxes: FloatArray32, rows: NDArray[np.bool_], *, P2: FloatArray, size_hw: tuple[int, int]) -> FloatArray32:
    """Turn boxes to fit their 2D boxes.

    Args:
        boxes: (N, 11) network pixels, metres, radians; columns of `runtime.boxcode`.
        rows: (N,) bool, which boxes may turn; those nearer than 3 m never do.
        P2: (3, 4) of the network image.
        size_hw: of the network image.

    Returns:
        A copy with other alphas.
    """
    turned = boxes.copy()
    chosen = np.flatnonzero(rows & (boxes[:, Z] > MIN_DEPTH_M))
    if chosen.size:
        wide = boxes[chosen].astype(np.float64)
        ray_rad = np.arctan2(wide[:, CX] - P2[0, 2], P2[0, 0])
        yaw_rad, _ = climb_yaw(wide, wide[:, ALPHA] + ray_rad, P2=P2, size_hw=size_hw)
        turned[chosen, ALPHA] = yaw_rad - ray_rad
    return turned


def climb_yaw(
    boxes: FloatArray, yaw_rad: FloatArray, *, P2: FloatArray, size_hw: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """The climb itself.

    Args:
        boxes: (N, 11) float64, as for `climb`; alpha is not read.
        yaw_rad: (N,) where each box starts.
        P2: (3, 4) of the network image.
        size_hw: of the network image.

    Returns:
        (N,) yaw, not wrapped, and (N,) its IoU.
    """
    best = outline_iou(boxes, yaw_rad, P2=P2, size_hw=size_hw)
    step_rad = np.full(len(boxes), FIRST_STEP_RAD)
    while (active := np.flatnonzero(step_rad > LAST_STEP_RAD)).size:
        sides = yaw_rad[active] + np.array([[-1.0], [1.0]]) * step_rad[active]
        ious = np.stack([outline_iou(boxes[active], side, P2=P2, size_hw=size_hw) for side in sides])
        better = ious.argmax(axis=0)
        columns = np.arange(len(active))
        climbs = ious[better, columns] > best[active]
        moved, stayed = active[climbs], active[~climbs]
        yaw_rad = yaw_rad.copy()
        yaw_rad[moved] = sides[better, columns][climbs]
        best[moved] = ious[better, columns][climbs]
        step_rad[stayed] /= 2
    return yaw_rad, best


def outline_iou(boxes: FloatArray, yaw_rad: FloatArray, *, P2: FloatArray, size_hw: tuple[int, int]) -> FloatArray:
    """(N,) IoU of each 2D box with the outline of its 3D box at a yaw, cut at the image.

    All in the left camera's own frame: P2 without its last column, so that z is its depth there (official behaviour).
    """
    depth_m = boxes[:, Z, None]
    focal_xy, center_xy = (P2[0, 0], P2[1, 1]), (P2[0, 2], P2[1, 2])
    side = 0.5 * boxes[:, WIDTH, None] * _SIDE
    ahead = 0.5 * boxes[:, LENGTH, None] * _AHEAD
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    corner_x = (boxes[:, CX, None] - center_xy[0]) * depth_m / focal_xy[0] + ahead * cos + side * sin
    corner_y = (boxes[:, CY, None] - center_xy[1]) * depth_m / focal_xy[1] + 0.5 * boxes[:, HEIGHT, None] * _UP
    corner_z = np.maximum(depth_m - ahead * sin + side * cos, DEPTH_GUARD_M)
    columns = focal_xy[0] * corner_x / corner_z + center_xy[0]
    rows = focal_xy[1] * corner_y / corner_z + center_xy[1]
    height, width = size_hw
    outline = np.stack([columns.min(axis=1), rows.min(axis=1), columns.max(axis=1), rows.max(axis=1)], axis=1)
    outline = np.clip(outline, 0.0, np.array([width, height, width, height], np.float64))
    return _paired_iou(boxes[:, X1 : Y2 + 1], outline)


def _paired_iou(first: FloatArray, second: FloatArray) -> FloatArray:
    extent = np.minimum(first[:, 2:], second[:, 2:]) - np.maximum(first[:, :2], second[:, :2])
    overlap = np.maximum(extent, 0.0).prod(axis=1)
    areas = [(box[:, 2:] - box[:, :2]).prod(axis=1) for box in (first, second)]
    union = areas[0] + areas[1] - overlap
    iou: FloatArray = np.divide(overlap, union, out=np.zeros_like(overlap), where=union > 0)
    return iou
