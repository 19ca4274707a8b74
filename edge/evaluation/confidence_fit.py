"""Learns the probability that a box is right in 3D (`runtime.refinement.confidence`) from labelled frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.outcomes import SAME_PLACE
from edge.evaluation.rules import CLASS_RULES
from edge.evaluation.tables import detection_table, label_table, pair_table
from runtime.contracts.errors import EdgeError
from runtime.contracts.geometry import FloatArray
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.refinement import Refined, confidence_features, no_surer, probability

FEWEST_RIGHT = 50
"""Boxes of a class that must be right, and as many wrong: fewer say little of ten weights."""
_LEAST_IMPORTANCE = 0.05
_RIDGE = 1e-3
"""On weights of features in units of their deviation."""
_STEPS = 50


class TooFewBoxesError(EdgeError):
    """Frames hold too few right or wrong boxes of a class to learn from."""


@dataclass(frozen=True, slots=True)
class ConfidenceFit:
    """One class.

    Attributes:
        name: of the class.
        weights: as the manifest has them, the constant last.
        boxes, right: how many it was learned from.
        loss_before, loss_after: mean -log of what was said of a box, by the network's scores, and by weights that were
            learned without its frame (of every other frame).
    """

    name: str
    weights: tuple[float, ...]
    boxes: int
    right: int
    loss_before: float
    loss_after: float


def fit_confidence(
    found: Sequence[Refined], labels: Sequence[Objects3D], image_widths: Sequence[int], name: str
) -> ConfidenceFit:
    """Learns one class's weights.

    A box counts as right from the class's loosest 3D overlap with a label of its class on; those that nobody can judge
    teach nothing. Boxes count by the network's score: the many of little score would drown what the surest have to say.

    Args:
        found: boxes of each frame with the network's scores.
        labels: of each frame.
        image_widths: of each frame, pixels.
        name: of the class, one of KITTI's three.

    Raises:
        TooFewBoxesError: too few boxes are right, or wrong.
    """
    judged_rows = judged_boxes(labels, [item.detections for item in found])
    features, right, scores, frames = [], [], [], []
    for number, (item, judged, width) in enumerate(zip(found, judged_rows, image_widths, strict=True)):
        rows = np.array([item.detections.class_names[index] == name for index in item.detections.class_id], np.bool_)
        rows &= ~np.isnan(judged)
        features.append(confidence_features(item, width)[rows])
        right.append(judged[rows] > 0)
        scores.append(item.detections.score[rows])
        frames.append(np.full(np.count_nonzero(rows), number))
    table, target, score, frame = (np.concatenate(parts) for parts in (features, right, scores, frames))
    count = int(np.count_nonzero(target))
    if min(count, len(target) - count) < FEWEST_RIGHT:
        raise TooFewBoxesError(
            f"confidence: found {count} right and {len(target) - count} wrong boxes of {name}, expected at least "
            f"{FEWEST_RIGHT} of both; give more labelled frames"
        )
    importance = np.maximum(score, _LEAST_IMPORTANCE)
    told = np.zeros(len(target))
    for part in (0, 1):
        others, own = frame % 2 != part, frame % 2 == part
        learned = probability(table[own], _learn(table[others], target[others], importance[others]))
        told[own] = no_surer(learned, score[own])
    return ConfidenceFit(
        name=name,
        weights=tuple(float(value) for value in _learn(table, target, importance)),
        boxes=len(target),
        right=count,
        loss_before=_loss(score, target, importance),
        loss_after=_loss(told, target, importance),
    )


def judged_boxes(labels: Sequence[Objects3D], found: Sequence[Detections3D]) -> list[FloatArray]:
    """Of each frame (N,): 1 where a box overlaps a label of its class by the loosest 3D overlap or more, else 0.

    NaN where nobody can tell: it lies over a region without labels, or over an object of the class's neighbour.
    """
    label_rows, box_rows = label_table(labels), detection_table(found)
    pairs = pair_table(label_rows, box_rows)
    judged = np.where(pairs.region_cover >= SAME_PLACE, np.nan, 0.0)
    least, neighbour = np.full(len(KITTI_CLASSES), np.inf), np.full(len(KITTI_CLASSES), -1)
    for rule in CLASS_RULES:
        own = KITTI_CLASSES.index(rule.name)
        least[own] = min(rule.min_overlap["3d"])
        neighbour[own] = -1 if rule.neighbour is None else KITTI_CLASSES.index(rule.neighbour)
    kind, labelled = box_rows.class_id[pairs.detection], label_rows.class_id[pairs.label]
    beside = (pairs.overlap["2d"] >= SAME_PLACE) & (labelled == neighbour[kind])
    judged[pairs.detection[beside]] = np.nan
    right = (labelled == kind) & (pairs.overlap["3d"] >= least[kind])
    judged[pairs.detection[right]] = 1.0
    return np.split(judged, np.cumsum([len(item) for item in found])[:-1])


def _learn(features: FloatArray, right: NDArray[np.bool_], importance: FloatArray) -> FloatArray:
    """(features + 1,) weights of a logistic regression, by Newton's method, the constant last."""
    center, spread = features.mean(axis=0), features.std(axis=0)
    spread = np.where(spread > 0, spread, 1.0)
    table = np.hstack([(features - center) / spread, np.ones((len(features), 1))])
    ridge = np.diag([_RIDGE] * features.shape[1] + [0.0])
    weights = np.zeros(table.shape[1])
    share = importance / importance.sum()
    for _ in range(_STEPS):
        told = probability(table[:, :-1], weights)
        slope = table.T @ (share * (told - right)) + ridge @ weights
        curvature = (table * (share * told * (1.0 - told))[:, None]).T @ table + ridge
        weights -= np.linalg.solve(curvature, slope)
    factors = weights[:-1] / spread
    return np.append(factors, weights[-1] - factors @ center)


def _loss(told: FloatArray, right: NDArray[np.bool_], importance: FloatArray) -> float:
    said = np.where(right, told, 1.0 - told)
    return float(-(importance * np.log(np.maximum(said, 1e-12))).sum() / importance.sum())
