"""AP of the objects in one band of distance at a time: where along the road a model, or its 8 bits, fails.

A label outside the band counts as not asked for: what finds it is neither right nor wrong. A detection stays
in a band where its own distance lies within, or where it overlaps a label of the band in the image, so that an
object seen at the wrong depth is judged in the band where it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from edge.evaluation.agreement import BAND_EDGES_M, BAND_NAMES, pair_up
from edge.evaluation.bootstrap import ap_drop, frame_weights
from edge.evaluation.kitti_ap import Evaluation, evaluate
from edge.evaluation.rules import NOT_ASKED_FOR
from runtime.contracts.objects import Detections3D, Objects3D

LEVEL = 1  # moderate
METRICS = (("Car", "3d", "0.7"), ("Pedestrian", "3d", "0.5"), ("Cyclist", "3d", "0.5"))


@dataclass(frozen=True, slots=True)
class DistanceRow:
    """One class in one band: 3D AP R40, moderate.

    Attributes:
        name: class; band: metres; objects: labelled objects that count.
        reference, other: AP in per cent.
        drop: points lost; interval95: of the paired bootstrap over frames.
    """

    name: str
    band: str
    objects: int
    reference: float
    other: float
    drop: float
    interval95: tuple[float, float]


def ap_by_distance(
    labels: Sequence[Objects3D],
    reference: Sequence[Detections3D],
    other: Sequence[Detections3D],
    classes: Sequence[str],
) -> list[DistanceRow]:
    """Score two models on the same labelled frames, band by band; bands without objects are left out."""
    rows = []
    for number, band in enumerate(BAND_NAMES):
        edges_m = (BAND_EDGES_M[number], BAND_EDGES_M[number + 1])
        inside = [_in_band(item.center_in_camera, edges_m) for item in labels]
        kept = [_only(item, rows_in) for item, rows_in in zip(labels, inside, strict=True)]
        first, second = (
            _shown(evaluate(kept, [_near(*item, edges_m) for item in zip(found, labels, inside, strict=True)], classes))
            for found in (reference, other)
        )
        weights = frame_weights(first.frames)
        lost = ap_drop(first, second, reference_draws=first.draws(weights), other_draws=second.draws(weights))
        before, after = first.ap(), second.ap()
        for name, metric, overlap in METRICS:
            count = first.objects.get(name, [0, 0, 0])[LEVEL]
            if not count:
                continue
            low, high = lost.interval95[name][metric][overlap]["R40"][LEVEL]
            values = [tree[name][metric][overlap]["R40"][LEVEL] for tree in (before, after, lost.points)]
            rows.append(DistanceRow(name, band, count, *values, (low, high)))
    return sorted(rows, key=lambda row: [item[0] for item in METRICS].index(row.name))


def _shown(evaluation: Evaluation) -> Evaluation:
    """Only the curves of `METRICS`: drawing the others again a thousand times takes longer than all else here."""
    return replace(evaluation, records={key: item for key, item in evaluation.records.items() if key in METRICS})


def _in_band(centers: np.ndarray, edges_m: tuple[float, float]) -> np.ndarray:
    distance_m = np.linalg.norm(centers, axis=1)
    return (distance_m >= edges_m[0]) & (distance_m < edges_m[1])


def _only(labels: Objects3D, inside: np.ndarray) -> Objects3D:
    return replace(labels, truncation=np.where(inside, labels.truncation, NOT_ASKED_FOR))


def _near(found: Detections3D, labels: Objects3D, inside: np.ndarray, edges_m: tuple[float, float]) -> Detections3D:
    kept = _in_band(found.center_in_camera, edges_m)
    pairs = pair_up(found, labels)
    kept[pairs.first] = inside[pairs.second]
    return found.select(kept)
