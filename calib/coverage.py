"""Chooses rows that cover a pool of rows, and says how well they do. Pure functions, no pixels.

Farthest-point choice (Gonzalez, Clustering to minimize the maximum intercluster distance, 1985): begin in the
middle, then always take the row that lies farthest from all taken so far. ``coverage_order`` weighs this against the
mean: it takes the row that brings the pool as a whole nearest to the taken ones, so that a single odd frame does not
outweigh what the camera sees all day. Either way every first part of the order is itself the choice of that size.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.scene_features import FeatureGroup
from runtime.contracts.errors import FormatError

Points = NDArray[np.float64]
Order = tuple[int, ...]

_FARTHEST = 3.0  # standard deviations; whatever lies beyond is as odd as can be
_DECIMALS = 9  # ties are ties on every machine


def comparable(rows: NDArray[np.float32], groups: Sequence[FeatureGroup]) -> Points:
    """Puts rows of features into one unit: standard deviations of the pool, each group of the same weight.

    A feature that hardly varies is divided by its group's floor instead, so that noise does not count as variety.

    Args:
        rows: (N, F) features.
        groups: what the columns are; their sizes sum up to F.

    Returns:
        (N, F) float64; the distance of two rows is how different their scenes are.

    Raises:
        FormatError: rows and groups do not fit.
    """
    sizes = [group.size for group in groups]
    if rows.ndim != 2 or rows.shape[1] != sum(sizes):
        raise FormatError(f"features: found rows of shape {rows.shape}; expected (N, {sum(sizes)}); compute them again")
    values = rows.astype(np.float64)
    floors = np.repeat([group.floor for group in groups], sizes)
    weights = np.repeat([size**-0.5 for size in sizes], sizes)
    deviations = (values - np.median(values, axis=0)) / np.maximum(values.std(axis=0), floors)
    return np.clip(deviations, -_FARTHEST, _FARTHEST) * weights


def distances(points: Points) -> Points:
    """(N, N) distances between all rows."""
    squares = np.einsum("ij,ij->i", points, points)
    between = squares[:, None] + squares[None, :] - 2.0 * points @ points.T
    found: Points = np.round(np.sqrt(np.maximum(between, 0.0)), _DECIMALS)
    np.fill_diagonal(found, 0.0)
    return found


def farthest_order(between: Points, wanted: int) -> Order:
    """Rows by farthest-point choice, the middle one first; among equals the first one."""

    def next_row(nearest: Points) -> int:
        return int(nearest.argmax())

    return _greedy(between, wanted, next_row)


def coverage_order(between: Points, wanted: int) -> Order:
    """Rows by how much nearer each brings the whole pool, the middle one first; among equals the first one."""

    def next_row(nearest: Points) -> int:
        left_over = np.round(np.minimum(nearest[:, None], between).sum(axis=0), _DECIMALS)
        left_over[nearest < 0] = np.inf
        return int(left_over.argmin())

    return _greedy(between, wanted, next_row)


def _greedy(between: Points, wanted: int, next_row: Callable[[Points], int]) -> Order:
    """Takes rows one by one; ``next_row`` sees each row's distance to the nearest taken one, -1 if taken itself."""
    if wanted < 1 or len(between) == 0:
        return ()
    order = [int(np.round(between.sum(axis=0), _DECIMALS).argmin())]
    nearest = between[order[0]].copy()
    nearest[order[0]] = -1.0
    while len(order) < min(wanted, len(between)):
        taken = next_row(nearest)
        order.append(taken)
        nearest = np.minimum(nearest, between[taken])
        nearest[taken] = -1.0
    return tuple(order)


@dataclass(frozen=True, slots=True)
class Coverage:
    """How well chosen frames stand for a pool.

    Attributes:
        score: 0 to 1. Mean distance of the pool's frames to the nearest chosen one, over their mean distance to the
            pool's middle frame, taken from 1: 0 says that one typical frame would do as well, 1 that every frame
            of the pool is chosen, or one just like it.
        even_score: the same for as many frames at equal distances in time.
        gap: distance of the frame that is covered worst, in standard deviations of a feature.
        pool: how many frames were looked at.
        looked_at: which kinds of features were compared.
    """

    score: float
    even_score: float
    gap: float
    pool: int
    looked_at: tuple[str, ...]


def score(between: Points, chosen: Sequence[int]) -> float:
    """`Coverage.score` of rows of a pool.

    Args:
        between: (N, N) distances.
        chosen: rows, at least one.
    """
    middle = float(between.mean(axis=0).min())
    if middle <= 0.0:
        return 1.0  # a pool of equal frames
    left_over = float(between[list(chosen)].min(axis=0).mean())
    return float(np.clip(1.0 - left_over / middle, 0.0, 1.0))


def gap(between: Points, chosen: Sequence[int]) -> float:
    """Distance of the row that is covered worst."""
    return float(between[list(chosen)].min(axis=0).max())
