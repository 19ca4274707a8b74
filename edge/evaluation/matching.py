"""KITTI's assignment of detections to labels, for all score thresholds at once.

The development kit matches anew for each of 41 thresholds. But what a frame contributes changes only at the
scores of
its own detections, so we match once for each of those and keep the changes: a list of events. The counts at
any threshold, under any weighting of the frames, are then sums over events; the bootstrap rests on that.

A label and a detection without a rival need no search. Only groups with rivals (several labels or detections
that overlap one another) go through the kit's greedy loop.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.evaluation.rules import ClassRule, Difficulty, Metric
from edge.evaluation.tables import DetectionTable, LabelTable, PairTable
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import FloatArray, IntArray

COUNTED, IGNORED, ABSENT = 0, 1, -1  # a box counts; is neither right nor wrong; does not take part


@dataclass(frozen=True, slots=True)
class MatchRecord:
    """What the frames contribute to one precision curve.

    Attributes:
        objects: (F,) labels that count, by frame.
        hit_score, hit_frame: (H,) scores of the detections that find a counting label when none is
            thresholded away, falling; the recall thresholds are picked from them.
        event_score, event_frame: (E,) score at which the counts of a frame change, falling.
        event_hits, event_false, event_similarity: (E,) what a frame gains once the threshold falls to the
            score: true positives, false positives, summed orientation similarity (1 + cos(alpha error)) / 2
                (0 but for metric 2d).
    """

    objects: IntArray
    hit_score: FloatArray
    hit_frame: IntArray
    event_score: FloatArray
    event_frame: IntArray
    event_hits: FloatArray
    event_false: FloatArray
    event_similarity: FloatArray


def label_states(labels: LabelTable, rule: ClassRule, difficulty: Difficulty) -> NDArray[np.int8]:
    """`COUNTED`, `IGNORED` or `ABSENT` for each label."""
    height_px = labels.box_in_left_image[:, 3] - labels.box_in_left_image[:, 1]
    hard_to_see = (
        (height_px < difficulty.min_height_px)
        | (labels.occlusion > difficulty.max_occlusion)
        | (labels.truncation > difficulty.max_truncation)
    )
    states = np.full(len(labels.frame), ABSENT, dtype=np.int8)
    same = labels.class_id == KITTI_CLASSES.index(rule.name)
    states[same] = np.where(hard_to_see[same], IGNORED, COUNTED)
    if rule.neighbour is not None:
        states[labels.class_id == KITTI_CLASSES.index(rule.neighbour)] = IGNORED
    return states


def detection_states(detections: DetectionTable, rule: ClassRule, difficulty: Difficulty) -> NDArray[np.int8]:
    """The same for each detection; low ones are ignored whatever their class, as in the development kit."""
    height_px = np.abs(detections.box_in_left_image[:, 3] - detections.box_in_left_image[:, 1])
    same = detections.class_id == KITTI_CLASSES.index(rule.name)
    states = np.where(same, COUNTED, ABSENT).astype(np.int8)
    states[height_px < difficulty.min_height_px] = IGNORED
    return states


@dataclass(frozen=True, slots=True)
class Evidence:
    """All frames' tables; what `match` draws on."""

    labels: LabelTable
    detections: DetectionTable
    pairs: PairTable


def match(
    evidence: Evidence, rule: ClassRule, difficulty: Difficulty, *, metric: Metric, min_overlap: float
) -> MatchRecord:
    """Assign detections to labels as the development kit does, at every threshold.

    Args:
        evidence: tables of all frames.
        rule: class to score.
        difficulty: which labels count.
        metric: overlap on the image, on the ground plane, or in space; DontCare regions excuse detections
            only on the image.
        min_overlap: overlaps must exceed it.
    """
    labels, detections, pairs = evidence.labels, evidence.detections, evidence.pairs
    label_state = label_states(labels, rule, difficulty)
    detection_state = detection_states(detections, rule, difficulty)
    overlap = pairs.overlap[metric]
    rows = np.flatnonzero(
        (overlap > min_overlap) & (label_state[pairs.label] != ABSENT) & (detection_state[pairs.detection] != ABSENT)
    )
    of_label, of_detection = pairs.label[rows], pairs.detection[rows]
    label_degree = np.bincount(of_label, minlength=len(labels.frame))
    detection_degree = np.bincount(of_detection, minlength=len(detections.frame))
    alone = (label_degree[of_label] == 1) & (detection_degree[of_detection] == 1)
    excused = pairs.region_cover > min_overlap if metric == "2d" else np.zeros(len(detections.frame), dtype=bool)
    similarity = np.zeros(len(rows))  # orientation is scored beside the image overlap only, as in the kit
    if metric == "2d":
        similarity = 0.5 * (1.0 + np.cos(labels.alpha_rad[of_label] - detections.alpha_rad[of_detection]))

    # A single pair: right if both count, else neither right nor wrong.
    right = alone & (label_state[of_label] == COUNTED) & (detection_state[of_detection] == COUNTED)
    hits = of_detection[right]
    # A detection that overlaps nothing: wrong if it counts and no region excuses it.
    wrong = np.flatnonzero((detection_degree == 0) & (detection_state == COUNTED) & ~excused)

    group_events, group_hits = _match_groups(
        of_label[~alone], of_detection[~alone], overlap[rows][~alone], similarity[~alone],
        label_state=label_state, detection_state=detection_state, score=detections.score, excused=excused,
    )  # fmt: skip
    group_table = np.array(group_events, dtype=np.float64).reshape(-1, 4)
    group_rows = group_table[:, 0].astype(np.int64)
    hit_rows = np.concatenate([hits, np.array(group_hits, dtype=np.int64)])
    event_rows = np.concatenate([hits, wrong, group_rows])
    return _record(
        labels.frame[label_state == COUNTED], hit_rows, event_rows, detections=detections,
        changes=np.concatenate([
            np.column_stack([np.ones(len(hits)), np.zeros(len(hits)), similarity[right]]),
            np.column_stack([np.zeros(len(wrong)), np.ones(len(wrong)), np.zeros(len(wrong))]),
            group_table[:, 1:],
        ]),
    )  # fmt: skip


def _record(
    object_frame: IntArray,
    hit_rows: IntArray,
    event_rows: IntArray,
    *,
    detections: DetectionTable,
    changes: FloatArray,
) -> MatchRecord:
    hit_rows = hit_rows[np.argsort(-detections.score[hit_rows], kind="stable")]
    order = np.argsort(-detections.score[event_rows], kind="stable")
    event_rows, changes = event_rows[order], changes[order]
    return MatchRecord(
        objects=np.bincount(object_frame, minlength=detections.frames),
        hit_score=detections.score[hit_rows],
        hit_frame=detections.frame[hit_rows],
        event_score=detections.score[event_rows],
        event_frame=detections.frame[event_rows],
        event_hits=changes[:, 0],
        event_false=changes[:, 1],
        event_similarity=changes[:, 2],
    )


def _match_groups(
    of_label: IntArray, of_detection: IntArray, overlap: FloatArray, similarity: FloatArray, *,
    label_state: NDArray[np.int8], detection_state: NDArray[np.int8], score: FloatArray, excused:
        NDArray[np.bool_],
) -> tuple[list[tuple[float, ...]], list[int]]:  # fmt: skip
    """Run the kit's greedy loop in every group of rivals.

    Returns:
        Events (detection row that has the score, hits, false positives, similarity gained) and the detection
        rows that hit without a threshold.
    """
    events: list[tuple[float, ...]] = []
    hits: list[int] = []
    for edges in _groups(of_label, of_detection):
        columns = (of_label, of_detection, overlap, similarity)
        group = _Group.of(*(column[edges].tolist() for column in columns))
        counts_label = {row: bool(label_state[row] == COUNTED) for row in group.rivals}
        detection_rows = sorted({row for rivals in group.rivals.values() for row, _ in rivals})
        counts_detection = {row: bool(detection_state[row] == COUNTED) for row in detection_rows}
        scores = {row: float(score[row]) for row in detection_rows}
        wrong_if_free = {row for row in detection_rows if counts_detection[row] and not excused[row]}
        hits += _highest_score_hits(group, counts_label, counts_detection, scores)
        before = (0, 0, 0.0)
        for threshold in sorted(set(scores.values()), reverse=True):
            active = {row for row in detection_rows if scores[row] >= threshold}
            hit_count, similarity_sum, taken = _greatest_overlap_hits(group, counts_label, counts_detection, active)
            now = (hit_count, len((wrong_if_free & active) - taken), similarity_sum)
            if now != before:
                row = next(row for row in detection_rows if scores[row] == threshold)
                events.append((row, now[0] - before[0], now[1] - before[1], now[2] - before[2]))
            before = now
    return events, hits


@dataclass(frozen=True, slots=True)
class _Group:
    """Labels in file order with the detections that overlap them, and each pair's orientation similarity."""

    rivals: dict[int, list[tuple[int, float]]]
    similarity: dict[tuple[int, int], float]

    @classmethod
    def of(cls, labels: list[int], detections: list[int], overlaps: list[float], similarities: list[float]) -> _Group:
        rivals: dict[int, list[tuple[int, float]]] = {}
        for label, detection, overlap in sorted(zip(labels, detections, overlaps, strict=True)):
            rivals.setdefault(label, []).append((detection, overlap))
        pairs = zip(labels, detections, similarities, strict=True)
        return cls(rivals, {(label, detection): value for label, detection, value in pairs})


def _groups(of_label: IntArray, of_detection: IntArray) -> Sequence[IntArray]:
    """Connected groups of edges: the smallest label row spreads until nothing changes."""
    if not of_label.size:
        return []
    name = np.arange(max(of_label.max(), 0) + 1)
    detection_name = np.full(of_detection.max() + 1, len(name))
    while True:
        np.minimum.at(detection_name, of_detection, name[of_label])
        spread = name.copy()
        np.minimum.at(spread, of_label, detection_name[of_detection])
        if np.array_equal(spread, name):
            break
        name = spread
    group = name[of_label]
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def _highest_score_hits(
    group: _Group, counts_label: dict[int, bool], counts_detection: dict[int, bool], scores: dict[int, float]
) -> list[int]:
    """Each label takes its free rival of the highest score: the kit's rule for collecting recall scores."""
    taken: set[int] = set()
    hits = []
    for label, rivals in group.rivals.items():
        free = [row for row, _ in rivals if row not in taken]
        if not free:
            continue
        best = max(free, key=lambda row: scores[row])
        taken.add(best)
        if counts_label[label] and counts_detection[best]:
            hits.append(best)
    return hits


def _greatest_overlap_hits(
    group: _Group, counts_label: dict[int, bool], counts_detection: dict[int, bool], active: set[int]
) -> tuple[int, float, set[int]]:
    """Each label takes its free rival of the greatest overlap; an ignored one only where no other is."""
    taken: set[int] = set()
    hits, similarity = 0, 0.0
    for label, rivals in group.rivals.items():
        best, best_overlap, ignored = None, 0.0, None
        for row, overlap in rivals:
            if row not in active or row in taken:
                continue
            if counts_detection[row]:
                if overlap > best_overlap:
                    best, best_overlap = row, overlap
            elif ignored is None:
                ignored = row
        chosen = best if best is not None else ignored
        if chosen is None:
            continue
        taken.add(chosen)
        if counts_label[label] and counts_detection[chosen]:
            hits += 1
            similarity += group.similarity[label, chosen]
    return hits, similarity, taken
