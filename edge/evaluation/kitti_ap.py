"""KITTI average precision of a whole set of frames: classes x metrics x overlaps x difficulties."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.evaluation.average_precision import AveragePrecision, average_precision
from edge.evaluation.matching import COUNTED, Evidence, MatchRecord, label_states, match
from edge.evaluation.rules import CLASS_RULES, DIFFICULTIES, EVALUATED_CLASSES, METRICS, ClassRule
from edge.evaluation.tables import (
    DetectionTable,
    LabelTable,
    check_same_frames,
    detection_table,
    label_table,
    pair_table,
)
from runtime.contracts.kitti import KITTI_CLASSES, MISSING_ALPHA_RAD
from runtime.contracts.objects import Detections3D, IntArray, Objects3D

ApTree = dict[str, dict[str, dict[str, dict[str, list[float]]]]]
"""class -> metric (``2d`` ``bev`` ``3d`` ``aos``) -> overlap -> ``R40``, ``R11`` -> easy, moderate, hard."""

CurveKey = tuple[str, str, str]
"""class, metric (``2d``, ``bev``, ``3d``), overlap."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Match records of one detector on labelled frames; AP under any weighting of the frames follows.

    Attributes:
        frames: frame count.
        records: (class, metric, overlap) to the records of easy, moderate, hard.
        objects: class to the [easy, moderate, hard] count of labelled objects.
        with_orientation: classes whose detections all have an observation angle.
    """

    frames: int
    records: dict[CurveKey, tuple[MatchRecord, ...]]
    objects: dict[str, list[int]]
    with_orientation: frozenset[str]

    def ap(self) -> ApTree:
        """The AP that the development kit gives, per cent."""
        weights = np.ones((1, self.frames), dtype=np.int64)
        return tree_of(self, lambda key, level: _numbers(average_precision(self.records[key][level], weights)))

    def draws(self, weights: IntArray) -> dict[CurveKey, list[AveragePrecision]]:
        """AP under each weighting (D, F) of the frames: curve to one value a difficulty."""
        return {key: [average_precision(item, weights) for item in levels] for key, levels in self.records.items()}


def _numbers(values: AveragePrecision) -> dict[str, float]:
    return {name: float(getattr(values, name)[0]) for name in ("r40", "r11", "orientation_r40", "orientation_r11")}


def tree_of(evaluation: Evaluation, value: Callable[[CurveKey, int], dict[str, Any]]) -> dict[str, Any]:
    """Arrange the values of every curve and difficulty as an `ApTree`.

    Args:
        evaluation: names the curves.
        value: curve and difficulty to ``r40``, ``r11``, ``orientation_r40``, ``orientation_r11``.
    """
    tree: dict[str, Any] = {}
    for key in evaluation.records:
        name, metric, overlap = key
        levels = [value(key, level) for level in range(len(DIFFICULTIES))]
        branch = tree.setdefault(name, {})
        branch.setdefault(metric, {})[overlap] = {
            "R40": [item["r40"] for item in levels],
            "R11": [item["r11"] for item in levels],
        }
        if metric == "2d" and name in evaluation.with_orientation:
            branch.setdefault("aos", {})[overlap] = {
                "R40": [item["orientation_r40"] for item in levels],
                "R11": [item["orientation_r11"] for item in levels],
            }
    return tree


def evaluate(
    labels: Sequence[Objects3D],
    detections: Sequence[Detections3D],
    classes: Sequence[str] = EVALUATED_CLASSES,
) -> Evaluation:
    """Match the detections of each frame with its labels.

    Args:
        labels: one record a frame.
        detections: one record a frame, in the same order.
        classes: which of Car, Pedestrian, Cyclist to score; others are passed over.

    Raises:
        FormatError: the two lists differ in length.
    """
    check_same_frames(labels, detections)
    label_rows, detection_rows = label_table(labels), detection_table(detections)
    evidence = Evidence(label_rows, detection_rows, pair_table(label_rows, detection_rows))
    rules = [rule for rule in CLASS_RULES if rule.name in classes]
    records: dict[CurveKey, tuple[MatchRecord, ...]] = {}
    for rule in rules:
        for metric in METRICS:
            for overlap in rule.min_overlap[metric]:
                records[rule.name, metric, str(overlap)] = tuple(
                    match(evidence, rule, level, metric=metric, min_overlap=overlap) for level in DIFFICULTIES
                )
    return Evaluation(
        frames=len(labels),
        records=records,
        objects={rule.name: count_objects(label_rows, rule) for rule in rules},
        with_orientation=frozenset(rule.name for rule in rules if _all_have_alpha(detection_rows, rule)),
    )


def count_objects(labels: LabelTable, rule: ClassRule) -> list[int]:
    """Labelled objects of a class that count at easy, moderate and hard."""
    return [int((label_states(labels, rule, level) == COUNTED).sum()) for level in DIFFICULTIES]


def _all_have_alpha(detections: DetectionTable, rule: ClassRule) -> bool:
    same = detections.class_id == KITTI_CLASSES.index(rule.name)
    return not bool((detections.alpha_rad[same] == MISSING_ALPHA_RAD).any())
