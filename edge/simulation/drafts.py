"""What a frame should hold: objects of each class, each with a depth bin, an occlusion level and a truncation bin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.simulation.label_statistics import (
    CLASSES,
    DEPTH_STEP_M,
    crowd_of,
    train_statistics,
)
from edge.simulation.placing import Footprint, draw_size

_PEOPLE = [CLASSES.index("Pedestrian"), CLASSES.index("Cyclist")]
_NEAR_M = 10.0
_GOLDEN = 0.6180339887498949
_OCCLUSION_TILT = (1.0, 1.25, 1.1)  # some wanted occlusions cannot be arranged: ask for more of them
_SMALLEST_LABEL_PX = 17.5


@dataclass(frozen=True, slots=True)
class Mix:
    """How much oftener than in KITTI's labels a set of frames shows something; all 1: as often.

    Attributes:
        people: factor on frames that hold pedestrians or cyclists.
        near: factor on objects within 10 m, whole or cut by the picture's edge.
    """

    people: float = 1.0
    near: float = 1.0


AS_LABELLED = Mix()


@dataclass(slots=True)
class Draft:
    """An object while positions are still being revised."""

    kind: str
    size_hwl: tuple[float, float, float]
    depth_range_m: tuple[float, float]
    occlusion: int
    truncation_bin: int
    s: float = 0.0
    t: float = 0.0
    yaw_rad: float = 0.0
    base: Footprint | None = None


@lru_cache(maxsize=1)
def label_tables() -> dict[str, Any]:
    """The statistics as arrays; counts ordered so that neighbouring entries are alike."""
    statistics = train_statistics()
    counts = np.array(sorted(statistics["counts"], key=lambda row: (sum(row[3:5]) > 0, sum(row[:3]), row)))
    tables: dict[str, Any] = {
        "statistics": statistics,
        "counts": counts[:, :-1],
        "count_weights": counts[:, -1],
    }
    for name in CLASSES:
        entry = statistics["classes"][name]
        tables[name] = (np.array(entry["appearance"]), np.array(entry["placement"]))
    return tables


def draw_counts(seed: int, mix: Mix = AS_LABELLED) -> NDArray[np.int64]:
    """Objects of each of `CLASSES` in the frame of a seed; seeds in a row sweep the distribution evenly."""
    tables = label_tables()
    position = (seed * _GOLDEN) % 1.0
    with_people = tables["counts"][:, _PEOPLE].sum(axis=1) > 0
    summed = np.cumsum(tables["count_weights"] * np.where(with_people, mix.people, 1.0))
    row = min(int(np.searchsorted(summed / summed[-1], position)), len(tables["counts"]) - 1)
    counts: NDArray[np.int64] = tables["counts"][row]
    return counts


def draw_drafts(counts: NDArray[np.int64], rng: np.random.Generator, *, focal_px: float, near: float) -> list[Draft]:
    tables = label_tables()
    crowd = int(crowd_of(int(counts.sum())))
    drafts = []
    for name, count in zip(CLASSES, counts, strict=True):
        appearance = tables[name][0]
        rows = appearance[appearance[:, 0] == crowd]
        rows = rows if rows[:, -1].sum() >= 20 else appearance
        weights = rows[:, -1] * np.array(_OCCLUSION_TILT)[rows[:, 2]]
        weights = weights * np.where((rows[:, 1] + 1) * DEPTH_STEP_M <= _NEAR_M, near, 1.0)
        weights = weights / weights.sum()
        for _ in range(int(count)):
            size = draw_size(name, tables["statistics"], rng)
            farthest_m = focal_px * size[0] / _SMALLEST_LABEL_PX
            _, depth_bin, occlusion, truncation, _ = rows[int(rng.choice(len(rows), p=weights))]
            far = min((depth_bin + 1) * DEPTH_STEP_M, farthest_m)  # what would be too small for a label comes nearer
            first = max(min(depth_bin * DEPTH_STEP_M, far - DEPTH_STEP_M), 1.0)
            drafts.append(
                Draft(name, size, (float(first), float(max(far, first + 0.1))), int(occlusion), int(truncation))
            )
    return drafts
