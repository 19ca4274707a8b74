"""Anti-aliased shapes with fractional coordinates and transparency, on uint8 BGR images, in place."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray
from runtime.sinks.palette import Colour

_SHIFT = 4
_ONE = 1 << _SHIFT
_FAR_PX = 1e5
"""Coordinates are kept within what OpenCV's fixed-point drawing can hold."""


def draw_line(
    image: NDArray[np.uint8], start_xy: FloatArray, end_xy: FloatArray, *, colour: Colour, width: int = 1
) -> None:
    """A straight line."""
    start, end = _fixed(np.stack([start_xy, end_xy]))
    cv2.line(image, start.tolist(), end.tolist(), colour, width, cv2.LINE_AA, _SHIFT)


def draw_outline(
    image: NDArray[np.uint8], points_xy: FloatArray, *, colour: Colour, width: int = 1, closed: bool = True
) -> None:
    """A polygon's border; points (N, 2)."""
    cv2.polylines(image, [_fixed(points_xy)], closed, colour, width, cv2.LINE_AA, _SHIFT)


def fill_polygon(image: NDArray[np.uint8], points_xy: FloatArray, *, colour: Colour, opacity: float = 1.0) -> None:
    """A filled convex polygon, mixed with what lies under it; points (N, 2)."""
    if len(points_xy) < 3:
        return
    height, width = image.shape[:2]
    low = np.maximum(np.floor(points_xy.min(axis=0)).astype(int) - 1, 0)
    high = np.minimum(np.ceil(points_xy.max(axis=0)).astype(int) + 2, (width, height))
    if (low >= high).any():
        return
    patch = image[low[1] : high[1], low[0] : high[0]]
    if opacity >= 1.0:
        cv2.fillConvexPoly(image, _fixed(points_xy), colour, cv2.LINE_AA, _SHIFT)
        return
    painted = patch.copy()
    cv2.fillConvexPoly(painted, _fixed(points_xy - low), colour, cv2.LINE_AA, _SHIFT)
    cv2.addWeighted(painted, opacity, patch, 1.0 - opacity, 0.0, dst=patch)


def fill_chip(
    image: NDArray[np.uint8], corner_xy: tuple[int, int], size_wh: tuple[int, int], *, colour: Colour
) -> None:
    """A filled rectangle with rounded corners."""
    (x, y), (width, height) = corner_xy, size_wh
    radius = min(4, height // 2)
    cv2.rectangle(image, (x + radius, y), (x + width - radius, y + height), colour, -1)
    cv2.rectangle(image, (x, y + radius), (x + width, y + height - radius), colour, -1)
    for centre in (
        (x + radius, y + radius),
        (x + width - radius, y + radius),
        (x + radius, y + height - radius),
        (x + width - radius, y + height - radius),
    ):
        cv2.circle(image, centre, radius, colour, -1, cv2.LINE_AA)


def _fixed(points_xy: FloatArray) -> NDArray[np.int32]:
    return np.rint(np.clip(points_xy, -_FAR_PX, _FAR_PX) * _ONE).astype(np.int32)
