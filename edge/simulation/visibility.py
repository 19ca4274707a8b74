"""Quick estimate of who hides whom: convex outlines painted from near to far, each in a small window of its own."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_NEAR_M = 0.4
_WINDOW_PX = 40
_SHIFT = 4  # fractional bits of OpenCV's polygon coordinates
_FAR_FIXED = 16000.0  # corners far outside a window, in its fixed-point units


class Outlines:
    """The projected hulls of a frame's objects, updated one object at a time."""

    def __init__(self, intrinsics: FloatArray, size_wh: tuple[int, int], camera_height_m: float) -> None:
        self._intrinsics = intrinsics
        self._size_wh = size_wh
        self._camera_y = -camera_height_m
        self.hulls: list[list[FloatArray]] = []  # convex pieces of each object
        self.boxes: list[FloatArray] = []  # unclipped x1 y1 x2 y2
        self.distances: list[float] = []

    def project(self, pieces: list[FloatArray]) -> tuple[list[FloatArray], FloatArray, float]:
        """Hull pixels (H, 2) of each piece, unclipped box (4,) and distance of an object's pieces (P, 3)."""
        points = np.concatenate(pieces)
        depth = np.maximum(points[:, 2], _NEAR_M)
        focal_x, focal_y = self._intrinsics[0, 0], self._intrinsics[1, 1]
        u = focal_x * points[:, 0] / depth + self._intrinsics[0, 2]
        v = focal_y * (points[:, 1] - self._camera_y) / depth + self._intrinsics[1, 2]
        pixels = np.stack([u, v], axis=1)
        ends = np.cumsum([len(piece) for piece in pieces])[:-1]
        hulls = [cv2.convexHull(part.astype(np.float32))[:, 0].astype(np.float64) for part in np.split(pixels, ends)]
        box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
        return hulls, box, float(np.hypot(points[:, 0], points[:, 2]).mean())

    def truncation(self, box: FloatArray) -> float:
        """Share of an unclipped box outside the image."""
        width, height = self._size_wh
        inside = max(0.0, min(box[2], width) - max(box[0], 0.0)) * max(0.0, min(box[3], height) - max(box[1], 0.0))
        return float(1.0 - inside / max((box[2] - box[0]) * (box[3] - box[1]), 1e-6))

    def visible_share(self, index: int) -> float:
        """Share of the object's outline inside the image that no nearer outline covers."""
        width, height = self._size_wh
        low = np.maximum(self.boxes[index][:2], 0.0)
        high = np.minimum(self.boxes[index][2:], [width, height])
        if (high - low < 0.5).any():
            return 0.0
        scale = _WINDOW_PX / float((high - low).max())
        size = np.maximum(np.ceil((high - low) * scale).astype(int), 1)
        canvas = np.zeros((size[1], size[0]), dtype=np.uint8)
        self._fill(canvas, self.hulls[index], low=low, scale=scale, value=1)
        total = cv2.countNonZero(canvas)
        if total == 0:
            return 0.0
        for other, box in enumerate(self.boxes):
            if other != index and self.distances[other] < self.distances[index] and _touch(box, low, high):
                self._fill(canvas, self.hulls[other], low=low, scale=scale, value=0)
        return cv2.countNonZero(canvas) / total

    def touched_by(self, *boxes: FloatArray) -> list[int]:
        """Objects whose box meets one of the given boxes."""
        return [index for index, own in enumerate(self.boxes) if any(_touch(own, box[:2], box[2:]) for box in boxes)]

    @staticmethod
    def _fill(canvas: NDArray[np.uint8], hulls: list[FloatArray], *, low: FloatArray, scale: float, value: int) -> None:
        factor = scale * (1 << _SHIFT)
        offset = low * factor + 0.5 * (1 << _SHIFT)
        for hull in hulls:
            corners = np.rint(np.minimum(np.maximum(hull * factor - offset, -_FAR_FIXED), _FAR_FIXED))
            cv2.fillConvexPoly(canvas, corners.astype(np.int32), value, shift=_SHIFT)


def _touch(box: FloatArray, low: FloatArray, high: FloatArray) -> bool:
    return bool(box[0] < high[0] and box[2] > low[0] and box[1] < high[1] and box[3] > low[1])
