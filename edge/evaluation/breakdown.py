"""AP and recall of the objects of one kind at a time: by distance, by occlusion, by truncation.

An object outside the band counts as not asked for. A detection that overlaps a labelled object in the image is judged
in that object's bands; any other by its own distance and, as it has neither occlusion nor truncation, in each band of
those. All objects of 25 pixels and more count, also those that KITTI's difficulties leave out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.evaluation.agreement import BAND_EDGES_M, BAND_NAMES, pair_up
from edge.evaluation.average_precision import average_precision
from edge.evaluation.bootstrap import PERCENTILES, frame_weights
from edge.evaluation.matching import Evidence, match
from edge.evaluation.outcomes import (
    FOUND,
    INVENTED_REASONS,
    LARGELY_OCCLUDED,
    MIN_HEIGHT_PX,
    MISSED_REASONS,
    Outcomes,
    Target,
    judge,
)
from edge.evaluation.rules import CLASS_RULES, NOT_ASKED_FOR, ClassRule, Difficulty
from edge.evaluation.tables import DetectionTable, LabelTable, detection_table, distances_m, label_table, pair_table
from runtime.contracts.errors import FormatError
from runtime.contracts.objects import Detections3D, Objects3D

DISTANCE, OCCLUSION, TRUNCATION = "distance", "occlusion", "truncation"
KINDS = (DISTANCE, OCCLUSION, TRUNCATION)
OCCLUSION_BANDS = ("visible", "partly", "largely")
TRUNCATION_EDGES = (0.0, 0.15, 0.30, 0.50, np.inf)
TRUNCATION_BANDS = ("0-0.15", "0.15-0.30", "0.30-0.50", "0.50+")
BANDS = {DISTANCE: BAND_NAMES, OCCLUSION: OCCLUSION_BANDS, TRUNCATION: TRUNCATION_BANDS}
ANY_OBJECT = Difficulty("any", MIN_HEIGHT_PX, LARGELY_OCCLUDED, 1.0)
_NO_CLASS = -1


@dataclass(frozen=True, slots=True)
class BandRow:
    """One class in one band.

    Attributes:
        name: class; kind: ``distance``, ``occlusion`` or ``truncation``; band: which.
        objects: labelled ones; found: of those, at the display score.
        recall, recall_interval95: share found, with the interval of the bootstrap over frames.
        recall_any: share found at any score that was kept.
        ap: 3D AP R40 in per cent at the looser overlap (Car 0.5, others 0.25).
        missed: reason -> objects; invented: reason -> detections by their own distance, empty for other kinds.
    """

    name: str
    kind: str
    band: str
    objects: int
    found: int
    recall: float
    recall_interval95: tuple[float, float]
    recall_any: float
    ap: float
    missed: dict[str, int]
    invented: dict[str, int]


@dataclass(frozen=True, slots=True)
class Breakdown:
    """All rows, and the cases that they count."""

    score: float
    outcomes: Outcomes
    rows: tuple[BandRow, ...]


def break_down(
    labels: Sequence[Objects3D],
    detections: Sequence[Detections3D],
    *,
    score: float,
    classes: Sequence[str],
    kinds: Sequence[str] = KINDS,
) -> Breakdown:
    """Split a run's AP, recall, misses and inventions.

    Args:
        labels, detections: one record a frame, in the same order.
        score: display threshold, for recall and inventions.
        classes: of the model.
        kinds: of `KINDS`, in the order wanted.

    Raises:
        FormatError: the lists differ in length, or a kind is unknown.
    """
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise FormatError(f"--by: found {unknown[0]!r}; expected some of {', '.join(KINDS)}; separate them by commas")
    outcomes = judge(labels, detections, score=score, classes=classes)
    truth, found = label_table(labels), detection_table(detections)
    evidence = Evidence(truth, found, pair_table(truth, found))
    partner = _partners(labels, detections)
    weights = frame_weights(len(labels))
    rows = []
    for rule in (rule for rule in CLASS_RULES if rule.name in classes):
        targets = [item for item in outcomes.targets if item.name == rule.name]
        for kind in kinds:
            for number, band in enumerate(BANDS[kind]):
                inside = [item for item in targets if band_of(item, kind) == number]
                invented = [
                    item.state
                    for item in outcomes.inventions
                    if kind == DISTANCE and item.name == rule.name and _distance_band(item.distance_m) == number
                ]
                if not inside and not invented:
                    continue
                ap = _ap(evidence, rule, kind, number, partner=partner) if inside else 0.0
                rows.append(_row(rule.name, kind, band, inside, invented=invented, ap=ap, weights=weights))
    return Breakdown(score, outcomes, tuple(rows))


def band_of(target: Target, kind: str) -> int:
    """Which of the kind's bands an object belongs to."""
    if kind == DISTANCE:
        return int(_distance_band(target.distance_m))
    return target.occlusion if kind == OCCLUSION else int(_truncation_band(target.truncation))


def _distance_band(distance_m: np.ndarray | float) -> np.ndarray:
    return np.searchsorted(BAND_EDGES_M, distance_m, side="right") - 1


def _truncation_band(truncation: np.ndarray | float) -> np.ndarray:
    return np.maximum(np.searchsorted(TRUNCATION_EDGES, truncation, side="left") - 1, 0)


def _partners(labels: Sequence[Objects3D], detections: Sequence[Detections3D]) -> np.ndarray:
    """(D,) row in the label table of the object that each detection overlaps in the image, -1 for none."""
    parts, first_label = [np.zeros(0, dtype=np.int64)], 0
    for truth, found in zip(labels, detections, strict=True):
        pairs = pair_up(found, truth)
        partner = np.full(len(found), -1, dtype=np.int64)
        partner[pairs.first] = pairs.second + first_label
        parts.append(partner)
        first_label += len(truth)
    return np.concatenate(parts)


def _ap(evidence: Evidence, rule: ClassRule, kind: str, number: int, *, partner: np.ndarray) -> float:
    labels, found = evidence.labels, evidence.detections
    inside = _labels_inside(labels, kind, number)
    kept = np.append(inside, False)[partner]  # the last entry serves those without a partner
    alone = partner < 0
    kept = np.where(alone, _own_distance(found, number) if kind == DISTANCE else True, kept)
    narrowed = Evidence(
        replace(labels, truncation=np.where(inside, labels.truncation, NOT_ASKED_FOR)),
        replace(found, class_id=np.where(kept, found.class_id, _NO_CLASS)),
        evidence.pairs,
    )
    record = match(narrowed, rule, ANY_OBJECT, metric="3d", min_overlap=rule.min_overlap["3d"][-1])
    return float(average_precision(record, np.ones((1, labels.frames), dtype=np.int64)).r40[0])


def _labels_inside(labels: LabelTable, kind: str, number: int) -> np.ndarray:
    if kind == DISTANCE:
        return _distance_band(distances_m(labels.solid)) == number
    return (labels.occlusion if kind == OCCLUSION else _truncation_band(labels.truncation)) == number


def _own_distance(found: DetectionTable, number: int) -> np.ndarray:
    return _distance_band(distances_m(found.solid)) == number


def _row(
    name: str,
    kind: str,
    band: str,
    inside: Sequence[Target],
    *,
    invented: Sequence[str],
    ap: float,
    weights: np.ndarray,
) -> BandRow:
    found = [item for item in inside if item.state == FOUND]
    objects = max(len(inside), 1)
    return BandRow(
        name=name,
        kind=kind,
        band=band,
        objects=len(inside),
        found=len(found),
        recall=len(found) / objects,
        recall_interval95=_recall_interval(inside, found, weights),
        recall_any=sum(item.score is not None for item in inside) / objects,
        ap=ap,
        missed={reason: sum(item.state == reason for item in inside) for reason in MISSED_REASONS},
        invented={reason: list(invented).count(reason) for reason in INVENTED_REASONS} if kind == DISTANCE else {},
    )


def _recall_interval(inside: Sequence[Target], found: Sequence[Target], weights: np.ndarray) -> tuple[float, float]:
    """95 % of the draws of the frames; those that draw no such object are left out."""
    frames = weights.shape[1]
    objects, hits = (
        weights @ np.bincount([item.frame for item in items], minlength=frames) for items in (inside, found)
    )
    drawn = objects > 0
    if not drawn.any():
        return (0.0, 0.0)
    low, high = np.percentile(hits[drawn] / objects[drawn], PERCENTILES)
    return float(low), float(high)
