"""Agreement of two models, pairing, distance bands, depth error."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.evaluation.agreement import agreement, by_band, pair_up
from edge.evaluation.depth_error import depth_errors
from runtime.contracts.errors import FormatError
from runtime.contracts.kitti import parse_labels
from runtime.contracts.measurement import NEAR_BAND
from runtime.contracts.objects import Detections3D

NAMES = ("Car", "Pedestrian")
EXACT_M = 1e-9  # metres; float64 differences of values up to 60


def boxes(*rows: tuple[str, float, float, float]) -> Detections3D:
    """Rows of class, score, left edge in pixels, depth in metres."""
    count = len(rows)
    left = np.array([row[2] for row in rows])
    return Detections3D(
        class_id=np.array([NAMES.index(row[0]) for row in rows]),
        score=np.array([row[1] for row in rows]),
        box_in_left_image=np.column_stack([left, np.full(count, 100.0), left + 100.0, np.full(count, 160.0)]),
        center_in_camera=np.column_stack([np.zeros(count), np.ones(count), [row[3] for row in rows]]),
        size_hwl=np.tile([1.5, 1.6, 3.9], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=NAMES,
    )


def agree(first: list[Detections3D], second: list[Detections3D], score: float = 0.5):
    return agreement(first, second, reference_score=score, other_score=score)


def test_nothing_found_by_either_is_full_agreement():
    empty = Detections3D.empty(NAMES)
    for frames in ([], [empty]):
        result = agree(frames, frames)
        assert (result.matched_share, result.matched_count, result.centre_error_m) == (1.0, 0, {})


def test_one_finds_nothing():
    result = agree([boxes(("Car", 0.9, 0.0, 10.0))], [Detections3D.empty(NAMES)])
    assert (result.matched_share, result.reference_count, result.other_count) == (0.0, 1, 0)


def test_different_frame_counts_are_refused():
    with pytest.raises(FormatError, match="expected the same"):
        agree([Detections3D.empty(NAMES)], [])


def test_class_and_overlap_and_threshold_decide():
    reference = [boxes(("Car", 0.9, 0.0, 10.0), ("Car", 0.8, 300.0, 20.0), ("Car", 0.4, 500.0, 30.0))]
    other = [boxes(("Pedestrian", 0.9, 0.0, 10.0), ("Car", 0.7, 310.0, 20.5), ("Car", 0.9, 500.0, 30.0))]
    result = agree(reference, other)
    # the first pair differs in class, the third is below the threshold on one side
    assert (result.reference_count, result.other_count, result.matched_count) == (2, 3, 1)
    assert result.matched_share == pytest.approx(2 / 5)
    assert result.centre_error_m["all"] == pytest.approx((0.5, 0.5), abs=EXACT_M)
    assert set(result.centre_error_m) == {"all", NEAR_BAND, "15-30"}


def test_the_higher_score_chooses_first():
    first = boxes(("Car", 0.9, 20.0, 10.0), ("Car", 0.6, 0.0, 10.0))
    pairs = pair_up(first, boxes(("Car", 0.8, 0.0, 10.0)))
    assert (pairs.first.tolist(), pairs.second.tolist(), pairs.only_first.tolist()) == ([0], [0], [1])


@settings(max_examples=50, deadline=None)
@given(lefts=st.lists(st.floats(0, 1000), max_size=8), seed=st.integers(0, 99))
def test_a_model_agrees_with_itself_in_any_order(lefts: list[float], seed: int):
    generator = np.random.default_rng(seed)
    scores = generator.permutation(np.linspace(0.55, 0.95, len(lefts)))
    one = boxes(*(("Car", float(score), left, 12.0) for score, left in zip(scores, lefts, strict=True)))
    result = agree([one], [one])
    assert result.matched_share == 1.0
    assert result.matched_count == len(lefts)


def test_bands_hold_their_lower_edge_and_empty_ones_are_absent():
    values = by_band(np.array([0.0, 15.0, 44.9, 45.0, 80.0]), np.arange(5.0))
    assert {name: part.tolist() for name, part in values.items()} == {
        "all": [0, 1, 2, 3, 4], NEAR_BAND: [0, 1], "0-15": [0], "15-30": [1], "30-45": [2], "45+": [3, 4],
    }  # fmt: skip


def test_depth_error_of_found_objects():
    label = "Car 0 0 0 {} 100 {} 160 1.5 1.6 3.9 0 1.75 {} 0"
    labels = [parse_labels("\n".join([label.format(0, 100, 10), label.format(300, 400, 20)]))]
    found = [boxes(("Car", 0.9, 0.0, 10.5), ("Car", 0.8, 300.0, 18.0), ("Car", 0.7, 600.0, 5.0))]
    errors = depth_errors(labels, found, score=0.5)
    assert set(errors) == {"Car"}
    whole = errors["Car"]["all"]
    assert whole.found == 2
    assert whole.median_abs_m == pytest.approx(1.25, abs=EXACT_M)
    assert whole.bias_m == pytest.approx(-0.75, abs=EXACT_M)
    assert errors["Car"]["15-30"].median_share == pytest.approx(0.1, abs=EXACT_M)


def test_depth_error_of_nothing():
    assert depth_errors([], [], score=0.5) == {}
