"""Depth from the pixels themselves: each found box is moved along its ray until both views of it match best.

The network sees the pair at a fraction of its resolution and in cells of 4 and 8 pixels; what it says of depth is good
to a third of a pixel or so, and in 8 bits a little less. The camera's images hold more. The visible surface of a box
(its two facing sides for vehicles, an upright plane for people) is sampled in the left image and looked up in the right
one at disparities around the network's; the one that matches best, with a mild preference for the network's own, gives
the new depth. The box keeps its place in the image, its size and its angles. The idea is that of dense alignment
(Stereo R-CNN, CVPR 2019, section 5); surface, matching cost, search and prior are this project's own.

Both views are compared after local normalisation, so that exposure may differ, and differences saturate, so that what
hides the object or shines through beside it counts little.
"""

from __future__ import annotations

import dataclasses
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Detections3D

Pixels = NDArray[np.uint8]
FloatImage = NDArray[np.float32]

SMOOTHING_PX: Final = 1.0
"""Deviation of the Gaussian that takes sensor noise and lookup error out before anything is compared."""
WINDOW_PX: Final = 11
"""Side of the square over which brightness and contrast are normalised."""
CONTRAST_FLOOR: Final = 2.0
"""Grey levels added to the local contrast: flat walls stay flat."""
SATURATION: Final = 1.0
"""Normalised difference from which on a pixel counts as not matching at all."""
RANGE_PX: Final = 4.0
RANGE_SHARE: Final = 0.06
"""Half the search, camera pixels of disparity: so many, and so large a share of the network's disparity."""
COARSE_STEPS, FINE_STEPS = 33, 9
PRIOR_PER_PX2: Final = 0.02
PRIOR_LIMIT_PX2: Final = 2.0
"""Cost of leaving the network's disparity, a squared pixel, and from where on it grows no more: the network errs by a
fraction of a pixel or is lost. A perfect mismatch of the pixels costs 1."""
LEAST_DISPARITY_PX: Final = 2.0
SURFACE_SHARE: Final = 0.92
"""Bodies are rounder than their boxes: the box's plan is shrunk by this before its sides are hit."""
VEHICLES: Final = frozenset({"Car", "Van", "Truck"})
VEHICLE_MARGINS, PERSON_MARGINS = (0.06, 0.15, 0.12), (0.25, 0.08, 0.12)
"""Shares of the 2D box that are left out at the sides, above and below."""
MOST_COLUMNS, MOST_ROWS, FEWEST = 28, 24, 4
SMALLEST_BOX_PX: Final = (6.0, 8.0)
_NO_MATCH: Final = 1e3


def refine_depths(found: Detections3D, left: Pixels, right: Pixels, geometry: StereoGeometry) -> Detections3D:
    """Moves boxes along their rays to where the two views match best.

    Args:
        found: N boxes in the camera's pixels and frame.
        left, right: (H, W, 3) uint8 BGR, the rectified pair.
        geometry: of the pair; a difference of the principal columns counts as an offset of all disparities.

    Returns:
        The same boxes, in the same order, with other centres. Boxes that are too small, too far or show no side are
        returned as they were.
    """
    if len(found) == 0:
        return found
    first, last = _rows(found, left.shape[0])
    views = tuple(_normalised(image[first:last]) for image in (left, right))
    P2, P3 = geometry.P2, geometry.P3
    focal_baseline, offset_px = float(P2[0, 3] - P3[0, 3]), float(P2[0, 2] - P3[0, 2])
    shift = np.array([P2[0, 3] / P2[0, 0], P2[1, 3] / P2[1, 1], 0.0])
    centers = found.center_in_camera.copy()
    for row in range(len(found)):
        kind = found.class_names[int(found.class_id[row])]
        columns, rows = _samples(found.box_in_left_image[row], left.shape[:2], kind)
        if len(rows) == 0:
            continue
        behind_m = _surface(
            columns, P2, centers[row] + shift, found.size_hwl[row], float(found.yaw_rad[row]), solid=kind in VEHICLES
        )
        hit = np.isfinite(behind_m)
        if np.count_nonzero(hit) < FEWEST - 1:
            continue
        search = _Search(views[0], views[1], columns[hit], rows - first, behind_m[hit], focal_baseline, offset_px)
        depth_m = search.best(float(centers[row, 2]))
        centers[row] = (centers[row] + shift) * (depth_m / centers[row, 2]) - shift
    return dataclasses.replace(found, center_in_camera=centers)


class _Search:
    """Samples of one box, and how badly they match at a depth."""

    def __init__(
        self,
        left: FloatImage,
        right: FloatImage,
        columns: FloatArray,
        rows: FloatArray,
        behind_m: FloatArray,
        focal_baseline: float,
        offset_px: float,
    ) -> None:
        self._right, self._columns, self._behind_m = right, columns, behind_m
        self._focal_baseline, self._offset_px = focal_baseline, offset_px
        grid = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        self._rows = grid[1]
        self._wanted = cv2.remap(left, grid[0], grid[1], cv2.INTER_LINEAR)

    def best(self, depth_m: float) -> float:
        """Depth of the centre, metres, at which the samples match best; starts from the network's."""
        start_px = self._focal_baseline / depth_m
        reach_px = RANGE_PX + RANGE_SHARE * start_px
        moves = np.linspace(-reach_px, reach_px, COARSE_STEPS)
        moves = moves[start_px + moves > LEAST_DISPARITY_PX]
        if len(moves) < 3:
            return depth_m
        step = moves[1] - moves[0]
        middle = moves[int(np.argmin(self._costs(start_px, moves)))]
        fine = np.linspace(middle - step, middle + step, FINE_STEPS)
        fine = fine[start_px + fine > LEAST_DISPARITY_PX]
        costs = self._costs(start_px, fine)
        lowest = int(np.argmin(costs))
        move = float(fine[lowest])
        if 0 < lowest < len(fine) - 1:
            before, here, after = costs[lowest - 1 : lowest + 2]
            move += 0.5 * float(fine[1] - fine[0]) * float((before - after) / (before - 2 * here + after + 1e-9))
        return self._focal_baseline / (start_px + move)

    def _costs(self, start_px: float, moves: FloatArray) -> FloatArray:
        """(K,) mean saturated difference of the views, plus the prior, when the centre's disparity moves."""
        depths = np.maximum((self._focal_baseline / (start_px + moves))[:, None] + self._behind_m, 1.0)
        looked_up = (self._columns - self._offset_px - self._focal_baseline / depths).astype(np.float32)
        count, height = len(moves), self._rows.shape[0]
        columns = np.repeat(looked_up[:, None, :], height, axis=1).reshape(count * height, -1)
        seen = cv2.remap(
            self._right,
            columns,
            np.tile(self._rows, (count, 1)),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=_NO_MATCH,
        ).reshape(count, height, -1)
        differences = np.minimum(np.abs(seen - self._wanted) / SATURATION, 1.0)
        costs: FloatArray = differences.mean(axis=(1, 2), dtype=np.float64)
        costs += PRIOR_PER_PX2 * np.minimum(moves**2, PRIOR_LIMIT_PX2)
        return costs


def _rows(found: Detections3D, height: int) -> tuple[int, int]:
    """First and last image row that any box, and the window about it, reaches."""
    boxes = found.box_in_left_image
    first = int(np.clip(np.floor(boxes[:, 1].min()) - WINDOW_PX, 0, height - 1))
    last = int(np.clip(np.ceil(boxes[:, 3].max()) + WINDOW_PX, first + 1, height))
    return first, last


def _normalised(image: Pixels) -> FloatImage:
    """Grey with local mean 0 and local contrast near 1."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), SMOOTHING_PX)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.blur(grey, window)
    contrast = np.sqrt(np.maximum(cv2.blur(grey * grey, window) - mean * mean, 0.0)) + CONTRAST_FLOOR
    result: FloatImage = ((grey - mean) / contrast).astype(np.float32, copy=False)
    return result


def _samples(box: FloatArray, size_hw: tuple[int, int], kind: str) -> tuple[FloatArray, FloatArray]:
    """Columns and rows of the left image at which a box is looked at; no rows where it is too small."""
    limit = np.array([size_hw[1] - 1.0, size_hw[0] - 1.0])
    low, high = np.clip(box[:2], 0.0, limit), np.clip(box[2:], 0.0, limit)
    extent = high - low
    if np.any(extent < SMALLEST_BOX_PX):
        return np.zeros(0), np.zeros(0)
    sides, above, below = VEHICLE_MARGINS if kind in VEHICLES else PERSON_MARGINS
    first, last = low + extent * (sides, above), high - extent * (sides, below)
    counts = [
        int(np.clip(round(last[axis] - first[axis]), FEWEST, most))
        for axis, most in ((0, MOST_COLUMNS), (1, MOST_ROWS))
    ]
    return np.linspace(first[0], last[0], counts[0]), np.linspace(first[1], last[1], counts[1])


def _surface(
    columns: FloatArray, P2: FloatArray, center: FloatArray, size_hwl: FloatArray, yaw_rad: float, *, solid: bool
) -> FloatArray:
    """(N,) metres from the centre's depth to that of the surface seen in each column; NaN where it is missed.

    Args:
        columns: (N,) of the left image.
        P2: (3, 4).
        center: (3,) of the box in the left camera's own frame, metres.
        size_hwl: (3,) metres.
        yaw_rad: about y.
        solid: sides of the box's shrunk plan; else the upright plane through the centre.
    """
    if not solid:
        return np.zeros(len(columns))
    half = 0.5 * SURFACE_SHARE * size_hwl[[2, 1]]
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    ray = (columns - P2[0, 2]) / P2[0, 0]
    turn = np.array([[cos, -sin], [sin, cos]])  # (x, z) to (along the length, across it)
    origin = turn @ -center[[0, 2]]
    direction = turn @ np.stack([ray, np.ones_like(ray)])
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = (np.array([[-1.0], [1.0]])[:, None] * half[:, None] - origin[:, None]) / direction
    enter, leave = crossings.min(axis=0).max(axis=0), crossings.max(axis=0).min(axis=0)
    behind_m: FloatArray = np.where(leave >= enter, enter - center[2], np.nan)
    return behind_m
