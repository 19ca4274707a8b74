"""Events against the development kit's procedure written out plainly: one matching for each threshold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.evaluation.average_precision import average_precision, recall_hits
from edge.evaluation.matching import ABSENT, COUNTED, Evidence, MatchRecord, detection_states, label_states, match
from edge.evaluation.rules import CLASS_RULES, DIFFICULTIES
from edge.evaluation.tables import detection_table, label_table, pair_table
from runtime.contracts.kitti import KITTI_CLASSES, parse_detections, parse_labels
from runtime.contracts.objects import Detections3D, Objects3D

EXACT = 1e-9  # per cent; the same sums in another order


def crowd(seed: int, frames: int = 3) -> tuple[list[Objects3D], list[Detections3D]]:
    """Overlapping boxes of two classes, some low, hidden or in DontCare regions, so that rivals are many."""
    generator = np.random.default_rng(seed)
    labels, found = [], []
    for _ in range(frames):
        lines, results = [], []
        for _ in range(generator.integers(0, 6)):
            x, z = generator.uniform(-2, 2), generator.uniform(9, 11)
            height = generator.choice([20.0, 30.0, 60.0])
            left = 600 + 20 * x
            kind = generator.choice(["Car", "Car", "Van", "Pedestrian"])
            box = f"{left:.2f} 100 {left + 50:.2f} {100 + height:.2f} 1.5 1.6 3.9 {x:.2f} 1.6 {z:.2f} 0.1"
            lines.append(f"{kind} 0.1 {generator.integers(0, 3)} 0.3 {box}")
        if generator.random() < 0.5:
            lines.append("DontCare -1 -1 -10 590 90 620 170 -1 -1 -1 -1000 -1000 -1000 -10")
        for _ in range(generator.integers(0, 9)):
            x, z = generator.uniform(-2, 2), generator.uniform(9, 11)
            height = generator.choice([20.0, 30.0, 60.0])
            left = 600 + 20 * x
            kind = generator.choice(["Car", "Car", "Car", "Pedestrian"])
            box = f"{left:.2f} 100 {left + 50:.2f} {100 + height:.2f} 1.5 1.6 3.9 {x:.2f} 1.6 {z:.2f} 0.1"
            results.append(f"{kind} -1 -1 {generator.uniform(-3, 3):.2f} {box} {generator.integers(1, 8) / 10}")
        labels.append(parse_labels("\n".join(lines)))
        found.append(parse_detections("\n".join(results)))
    return labels, found


def evidence_of(labels: list[Objects3D], found: list[Detections3D]) -> Evidence:
    rows, detections = label_table(labels), detection_table(found)
    return Evidence(rows, detections, pair_table(rows, detections))


def plain_ap(evidence: Evidence, rule, level, metric: str, overlap: float) -> tuple[float, float]:
    """R40 of detection and of orientation: the kit's loops as they stand, over all frames for every

    threshold.
    """
    labels, found, pairs = evidence.labels, evidence.detections, evidence.pairs
    table = np.zeros((len(labels.frame), len(found.frame)))
    table[pairs.label, pairs.detection] = pairs.overlap[metric]
    state, result = label_states(labels, rule, level), detection_states(found, rule, level)

    def run(threshold: float | None) -> tuple[list[float], int, float]:
        taken: set[int] = set()
        hit_scores, similarity = [], 0.0
        for label in np.flatnonzero(state != ABSENT):
            best, best_score, best_overlap, ignored_chosen = None, -np.inf, 0.0, False
            for row in np.flatnonzero(result != ABSENT):
                if row in taken or (threshold is not None and found.score[row] < threshold):
                    continue
                if table[label, row] <= overlap:
                    continue
                if threshold is None:
                    if found.score[row] > best_score:
                        best, best_score = row, found.score[row]
                elif (table[label, row] > best_overlap or ignored_chosen) and result[row] == COUNTED:
                    best, best_overlap, ignored_chosen = row, table[label, row], False
                elif best is None and result[row] != COUNTED:
                    best, ignored_chosen = row, True
            if best is None:
                continue
            taken.add(best)
            if state[label] == COUNTED and result[best] == COUNTED:
                hit_scores.append(float(found.score[best]))
                similarity += (1 + np.cos(labels.alpha_rad[label] - found.alpha_rad[best])) / 2
        false = 0
        for row in np.flatnonzero(result == COUNTED):
            excused = metric == "2d" and pairs.region_cover[row] > overlap
            below = threshold is not None and found.score[row] < threshold
            false += not (row in taken or below or excused)
        return hit_scores, false, similarity

    scores = sorted(run(None)[0], reverse=True)
    objects, recall, thresholds = int((state == COUNTED).sum()), 0.0, []
    for index, score in enumerate(scores):
        last = index == len(scores) - 1
        left, right = (index + 1) / objects, (index + 1 if last else index + 2) / objects
        if right - recall < recall - left and not last:
            continue
        thresholds.append(score)
        recall += 1 / 40
    precision, orientation = np.zeros(41), np.zeros(41)
    for index, threshold in enumerate(thresholds):
        hits, false, similarity = run(threshold)
        precision[index] = len(hits) / max(len(hits) + false, 1)
        orientation[index] = similarity / max(len(hits) + false, 1)
    curves = [np.maximum.accumulate(curve[::-1])[::-1] for curve in (precision, orientation)]
    return 100 * curves[0][1:].mean(), 100 * curves[1][1:].mean()


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 100_000), metric=st.sampled_from(["2d", "bev", "3d"]), level=st.integers(0, 2))
def test_equals_the_plain_procedure(seed: int, metric: str, level: int):
    evidence = evidence_of(*crowd(seed))
    rule, difficulty = CLASS_RULES[0], DIFFICULTIES[level]
    for overlap in (0.5, 0.25):
        record = match(evidence, rule, difficulty, metric=metric, min_overlap=overlap)
        got = average_precision(record, np.ones((1, 3), dtype=np.int64))
        expected, orientation = plain_ap(evidence, rule, difficulty, metric, overlap)
        assert got.r40[0] == pytest.approx(expected, abs=EXACT)
        if metric == "2d":
            assert got.orientation_r40[0] == pytest.approx(orientation, abs=EXACT)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 100_000), weights=st.lists(st.integers(0, 3), min_size=3, max_size=3))
def test_weights_are_repetitions(seed: int, weights: list[int]):
    labels, found = crowd(seed)
    rule, difficulty = CLASS_RULES[0], DIFFICULTIES[2]
    record = match(evidence_of(labels, found), rule, difficulty, metric="2d", min_overlap=0.5)
    weighted = average_precision(record, np.array([weights, [1, 1, 1]]))
    repeated = [index for index, count in enumerate(weights) for _ in range(count)]
    copies = evidence_of([labels[index] for index in repeated], [found[index] for index in repeated])
    again = match(copies, rule, difficulty, metric="2d", min_overlap=0.5)
    plain = average_precision(again, np.ones((1, len(repeated)), dtype=np.int64))
    for name in ("r40", "r11", "orientation_r40", "orientation_r11"):
        assert getattr(weighted, name)[0] == pytest.approx(getattr(plain, name)[0], abs=EXACT)


@pytest.mark.parametrize("objects", [1, 2, 13, 20, 39, 40, 41, 80, 127, 1000])
def test_recall_thresholds_equal_the_kit_walk(objects: int):
    for hits in {1, objects // 2 or 1, objects}:
        none = np.zeros(0)
        record = MatchRecord(
            objects=np.array([objects]),
            hit_score=np.linspace(1.0, 0.1, hits),
            hit_frame=np.zeros(hits, dtype=np.int64),
            event_score=none,
            event_frame=none.astype(np.int64),
            event_hits=none,
            event_false=none,
            event_similarity=none,
        )
        chosen, reached = recall_hits(record, np.ones((1, 1), dtype=np.int64))
        walked, recall = [], 0.0
        for index in range(hits):
            left, right = (index + 1) / objects, (index + 2) / objects
            if index < hits - 1 and right - recall < recall - left:
                continue
            walked.append(index)
            recall += 1 / 40
        assert chosen[0][reached[0]].tolist() == walked


def test_a_low_detection_of_another_class_can_take_a_label():
    # as in the kit: ignored for its height, whatever its class, it takes the label and spares a miss, not a
    # hit
    label = "Car 0.0 0 0.1 600 100 640 126 1.5 1.6 3.9 0 1.6 40 0.1"
    low = "Pedestrian -1 -1 0.1 600 101 640 125 1.5 1.6 3.9 0 1.6 40 0.1 0.9"
    evidence = evidence_of([parse_labels(label)], [parse_detections(low)])
    record = match(evidence, CLASS_RULES[0], DIFFICULTIES[1], metric="2d", min_overlap=0.7)
    assert record.objects.tolist() == [1]
    assert len(record.hit_score) == 0
    assert len(record.event_score) == 0


def test_unknown_classes_are_scored_nowhere():
    found = parse_detections("Bus -1 -1 0.1 600 100 640 160 1.5 1.6 3.9 0 1.6 40 0.1 0.9", ("Bus",))
    table = detection_table([found])
    assert "Bus" not in KITTI_CLASSES
    for rule in CLASS_RULES:
        assert (detection_states(table, rule, DIFFICULTIES[0]) == ABSENT).all()


@pytest.mark.parametrize(("height", "counts"), [(40.0, True), (39.99, False)])
def test_exact_height_counts(height: float, counts: bool):
    table = label_table([parse_labels(f"Car 0 0 0.1 600 100 640 {100 + height} 1.5 1.6 3.9 0 1.6 40 0.1")])
    assert bool((label_states(table, CLASS_RULES[0], DIFFICULTIES[0]) == COUNTED)[0]) is counts
