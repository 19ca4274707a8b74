"""KITTI's evaluation rules as data: classes, overlaps, difficulties, recall points.

Source: the KITTI object development kit (its limits, neighbouring classes and 41 recall points); heights
follow the
kit: a box of exactly 40 or 25 pixels counts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Metric = Literal["2d", "bev", "3d"]
METRICS: tuple[Metric, ...] = ("2d", "bev", "3d")
RECALL_POINTS = 41

NOT_ASKED_FOR = 2.0
"""A truncation beyond every difficulty's limit: whatever finds such an object is neither right nor wrong."""


@dataclass(frozen=True, slots=True)
class Difficulty:
    """Which labelled objects count.

    Attributes:
        name: ``easy``, ``moderate``, ``hard``.
        min_height_px: lower ones are ignored (labels and detections).
        max_occlusion: KITTI occlusion level.
        max_truncation: share outside the image.
    """

    name: str
    min_height_px: float
    max_occlusion: int
    max_truncation: float


DIFFICULTIES = (
    Difficulty("easy", 40.0, 0, 0.15),
    Difficulty("moderate", 25.0, 1, 0.30),
    Difficulty("hard", 25.0, 2, 0.50),
)


@dataclass(frozen=True, slots=True)
class ClassRule:
    """How one class is scored.

    Attributes:
        name: the class.
        neighbour: a class so similar that detections on it are neither right nor wrong; None for no such
            class.
        min_overlap: metric to the overlaps that AP is given at, the strict one first.
    """

    name: str
    neighbour: str | None
    min_overlap: dict[Metric, tuple[float, ...]]


CLASS_RULES = (
    ClassRule("Car", "Van", {"2d": (0.7,), "bev": (0.7, 0.5), "3d": (0.7, 0.5)}),
    ClassRule("Pedestrian", "Person_sitting", {"2d": (0.5,), "bev": (0.5, 0.25), "3d": (0.5, 0.25)}),
    ClassRule("Cyclist", None, {"2d": (0.5,), "bev": (0.5, 0.25), "3d": (0.5, 0.25)}),
)
LOWEST_OVERLAP = 0.25  # no rule asks for less: pairs below can be forgotten
EVALUATED_CLASSES = tuple(rule.name for rule in CLASS_RULES)
