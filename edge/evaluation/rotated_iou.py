"""Exact overlap of rotated rectangles on the ground plane, for many pairs at once.

Idea: seen from rectangle A, A is axis-aligned. Pulling every point of the plane to its nearest point of A (a
clamp of both coordinates) moves points outside A along paths that never enter A, so the outline of B,
clamped, still winds around each inner point of A as often as B does. Its signed area is therefore the area of
the intersection. A straight edge, clamped, bends only where it crosses one of A's four lines: four sorted
parameters an edge, no case distinction, no tolerance, no trouble with coinciding or touching edges.
"""

from __future__ import annotations

import numpy as np

from runtime.contracts.geometry import FloatArray
from runtime.contracts.objects import ground_corners


def intersection_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    """Area shared by each pair of rectangles.

    Args:
        first, second: (N, 5) x, z, length, width (metres), yaw (radians); row i of one is paired with row i
            of the other. Sides that are not positive give area 0.

    Returns:
        (N,) square metres.
    """
    areas = np.zeros(len(first))
    distance = np.hypot(first[:, 0] - second[:, 0], first[:, 1] - second[:, 1])
    reach = 0.5 * (np.hypot(first[:, 2], first[:, 3]) + np.hypot(second[:, 2], second[:, 3]))
    solid = (first[:, 2:4] > 0).all(axis=1) & (second[:, 2:4] > 0).all(axis=1)
    near = np.flatnonzero(solid & (distance < reach))
    if near.size:
        areas[near] = _clamped_areas(first[near], second[near])
    return areas


def _clamped_areas(first: FloatArray, second: FloatArray) -> FloatArray:
    offset = ground_corners(second[:, :2], second[:, 2:4], second[:, 4]) - first[:, None, :2]
    cos, sin = np.cos(first[:, None, 4]), np.sin(first[:, None, 4])
    along = offset[..., 0] * cos - offset[..., 1] * sin
    across = offset[..., 0] * sin + offset[..., 1] * cos
    start = np.stack([along, across], axis=-1)  # (N, 4, 2) corners of B in A's axes
    step = np.roll(start, -1, axis=1) - start
    half = 0.5 * first[:, None, 2:4]
    safe_step = np.where(step == 0.0, 1.0, step)  # an edge parallel to a line crosses it nowhere: any parameter will do
    with np.errstate(over="ignore"):
        crossings = np.concatenate([(half - start) / safe_step, (-half - start) / safe_step], axis=-1)
    at = np.sort(np.clip(crossings, 0.0, 1.0), axis=-1)  # (N, 4 edges, 4 crossings)
    at = np.concatenate([np.zeros_like(at[..., :1]), at], axis=-1)
    path = start[:, :, None, :] + at[..., None] * step[:, :, None, :]
    path = np.clip(path, -half[:, :, None, :], half[:, :, None, :]).reshape(len(first), -1, 2)
    following = np.roll(path, -1, axis=1)
    signed = path[..., 0] * following[..., 1] - path[..., 1] * following[..., 0]
    return 0.5 * np.abs(signed.sum(axis=1))
