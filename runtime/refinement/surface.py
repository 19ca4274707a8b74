"""Where a box is looked at, and how far behind or before its centre the surface lies that is seen there."""

from __future__ import annotations

from typing import Final

import numpy as np

from runtime.contracts.geometry import FloatArray

BODY_SHARES, CABIN_SHARES = (0.92, 0.92), (0.7, 0.85)
"""Bodies are rounder than their boxes and windows stand back: length and width of the plan whose sides are hit, as
shares of the box's, below and above the belt line."""
BELT_SHARE: Final = 0.42
"""Of the 2D box's height, from its top: where windows end."""
VEHICLES: Final = frozenset({"Car", "Van", "Truck"})
VEHICLE_MARGINS, PERSON_MARGINS = (0.06, 0.15, 0.12), (0.25, 0.08, 0.12)
"""Shares of the 2D box that are left out at the sides, above and below."""
MOST_COLUMNS, MOST_ROWS, FEWEST = 28, 24, 4
SMALLEST_BOX_PX: Final = (6.0, 8.0)


def sample_positions(box: FloatArray, size_hw: tuple[int, int], kind: str) -> tuple[FloatArray, FloatArray]:
    """Columns and rows of the left image at which a box is looked at; no rows where it is too small.

    Args:
        box: (4,) left, top, right, bottom, camera pixels.
        size_hw: of the image.
        kind: class name.
    """
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


def surface_behind_center(
    columns: FloatArray,
    down: FloatArray,
    P2: FloatArray,
    center: FloatArray,
    size_hwl: FloatArray,
    yaw_rad: float,
    *,
    solid: bool,
) -> FloatArray:
    """(R, C) metres from the centre's depth to that of the surface seen in each column; NaN where it is missed.

    Args:
        columns: (C,) of the left image.
        down: (R,) where each row stands between the 2D box's top (0) and bottom (1).
        P2: (3, 4).
        center: (3,) of the box in the left camera's own frame, metres.
        size_hwl: (3,) metres.
        yaw_rad: about y.
        solid: the facing sides of a vehicle's body and cabin; else the upright plane through the centre.
    """
    if not solid:
        return np.zeros((len(down), len(columns)))
    body, cabin = (
        _facing_sides(columns, P2, center, size_hwl[[2, 1]] * shares, yaw_rad) for shares in (BODY_SHARES, CABIN_SHARES)
    )
    cabin = np.where(np.isfinite(cabin), cabin, body)
    behind_m: FloatArray = np.where((down < BELT_SHARE)[:, None], cabin, body)
    behind_m[:, ~np.isfinite(body)] = np.nan
    return behind_m


def _facing_sides(
    columns: FloatArray, P2: FloatArray, center: FloatArray, plan_lw: FloatArray, yaw_rad: float
) -> FloatArray:
    """(C,) metres from the centre's depth to the upright sides of a plan of that length and width."""
    half = 0.5 * plan_lw
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
