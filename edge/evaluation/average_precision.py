"""From match records to AP: 41 recall thresholds, interpolated precision, R40 and R11."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edge.evaluation.matching import MatchRecord
from edge.evaluation.rules import RECALL_POINTS
from runtime.contracts.objects import FloatArray, IntArray

_CHUNK_ELEMENTS = 100_000  # draws x events held at once: they fit the cache


@dataclass(frozen=True, slots=True)
class AveragePrecision:
    """AP of D weightings of the frames, per cent.

    Attributes:
        r40, r11: (D,) of detection.
        orientation_r40, orientation_r11: (D,) of detection times orientation similarity (AOS).
    """

    r40: FloatArray
    r11: FloatArray
    orientation_r40: FloatArray
    orientation_r11: FloatArray


def average_precision(record: MatchRecord, weights: IntArray) -> AveragePrecision:
    """AP as the development kit computes it, had every frame been there ``weights`` times.

    R40 is the mean of points 1..40 of the 41-point interpolated precision, R11 that of points 0, 4, .., 40.

    Args:
        record: matches of all frames.
        weights: (D, F) how often each frame counts; one row a draw.
    """
    chunk = max(1, _CHUNK_ELEMENTS // max(len(record.event_score), 1))
    parts = [precision_curves(record, weights[start : start + chunk]) for start in range(0, len(weights), chunk)]
    precision = np.concatenate([part[0] for part in parts]) if parts else np.zeros((0, RECALL_POINTS))
    similarity = np.concatenate([part[1] for part in parts]) if parts else np.zeros((0, RECALL_POINTS))
    return AveragePrecision(_r40(precision), _r11(precision), _r40(similarity), _r11(similarity))


def _r40(curve: FloatArray) -> FloatArray:
    return 100.0 * curve[:, 1:].mean(axis=1)


def _r11(curve: FloatArray) -> FloatArray:
    return 100.0 * curve[:, ::4].mean(axis=1)


def precision_curves(record: MatchRecord, weights: IntArray) -> tuple[FloatArray, FloatArray]:
    """Interpolated precision and orientation similarity at the 41 recall points.

    Returns:
        Two (D, 41) arrays in [0, 1]; points beyond the reached recall are 0.
    """
    shape = (len(weights), RECALL_POINTS)
    if not len(record.hit_score):
        return np.zeros(shape), np.zeros(shape)
    hit, reached = recall_hits(record, weights)
    # The last event whose score is at least that of the hit: everything up to it counts at this threshold.
    last_event = np.searchsorted(-record.event_score, -record.hit_score, side="right") - 1
    at = last_event[hit]
    event_weights = np.take(weights.astype(np.float64), record.event_frame, axis=1)

    def counted(change: FloatArray) -> FloatArray:
        if not change.any():
            return np.zeros(shape)
        return np.take_along_axis(np.cumsum(event_weights * change, axis=1), at, axis=1)

    hits, false = counted(record.event_hits), counted(record.event_false)
    similarity = counted(record.event_similarity)
    found = hits + false
    curves = []
    for value in (hits, similarity):
        curve = np.divide(value, found, out=np.zeros(shape), where=reached & (found > 0))
        curves.append(np.maximum.accumulate(curve[:, ::-1], axis=1)[:, ::-1])
    return curves[0], curves[1]


def recall_hits(record: MatchRecord, weights: IntArray) -> tuple[IntArray, np.ndarray]:
    """The hits whose scores are the thresholds, one a recall step of 1/40.

    The kit walks the falling hits; it passes hit i (of n, with N objects) while (i+2)/N is nearer to the
    wanted recall c than (i+1)/N, and always takes the last. So step k takes the first i after the last taken
    one with 2c <= (2i+3)/N, up to rounding, which is settled with the kit's own expression.

    Returns:
        (D, 41) index into the record's hits, and (D, 41) whether the step was reached.
    """
    hit_weights = weights[:, record.hit_frame]
    copies = np.cumsum(hit_weights, axis=1)
    total_hits = copies[:, -1:]
    objects = np.maximum(weights @ record.objects, 1)[:, None]
    wanted = np.concatenate([[0.0], np.cumsum(np.full(RECALL_POINTS - 1, 1.0 / (RECALL_POINTS - 1)))])[None, :]
    first = np.maximum(np.floor(objects * wanted - 1.5).astype(np.int64) - 1, 0)
    for _ in range(3):
        passed = ((first + 2) / objects - wanted) < (wanted - (first + 1) / objects)
        first = first + passed
    steps = np.arange(RECALL_POINTS)[None, :]
    chosen = np.maximum.accumulate(first - steps, axis=1) + steps
    before = np.concatenate([np.full((len(weights), 1), -1), chosen[:, :-1]], axis=1)
    reached = before < total_hits - 1
    chosen = np.clip(chosen, 0, np.maximum(total_hits - 1, 0))
    # Hit that holds copy number `chosen`: one search for all draws, each draw moved to its own range of
    # numbers.
    stride = int(copies[:, -1].max()) + 1
    lift = stride * np.arange(len(weights))[:, None]
    found = np.searchsorted((copies + lift).ravel(), (chosen + lift).ravel(), side="right").reshape(chosen.shape)
    hit = found - copies.shape[1] * np.arange(len(weights))[:, None]
    return np.clip(hit, 0, copies.shape[1] - 1), reached
