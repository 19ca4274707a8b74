"""Scores that know depth: what a search tells, how weights turn it into a score, and what does not fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.confidence import ConfidenceRecord, read_confidence, write_confidence
from runtime.contracts.errors import FormatError, ManifestError
from runtime.contracts.objects import Detections3D
from runtime.refinement import FEATURES, Refined, check_confidence, confidence_features, with_confidence
from runtime.refinement.evidence import EVIDENCE, MOST_DIFFERENCE, UNSEARCHED, match_evidence

WIDTH = 600


def two_cars_and_a_person() -> Refined:
    found = Detections3D(
        class_id=[0, 0, 1],
        score=[0.9, 0.8, 0.7],
        box_in_left_image=[[100, 50, 160, 90], [0, 60, 40, 80], [300, 40, 320, 100]],
        center_in_camera=[[0, 1, 10.0], [-5, 1, 40.0], [1, 1, 12.0]],
        size_hwl=[[1.5, 1.6, 4.0], [1.5, 1.6, 4.0], [1.7, 0.6, 0.8]],
        alpha_rad=[0, 0, 0],
        yaw_rad=[0, 0, 0],
        class_names=("Car", "Pedestrian"),
    )
    return Refined(found, np.array([UNSEARCHED, (0.1, 0.2, 0.3, 0.4, 0.05, 0.6), UNSEARCHED]))


def test_a_search_with_two_minima() -> None:
    moves = np.linspace(-4, 4, 9)
    costs = np.array([0.9, 0.2, 0.9, 0.9, 0.5, 0.3, 0.1, 0.3, 0.9])  # -3 px: 0.2; 2 px: 0.1
    cost, gain, margin, shift, sharpness = match_evidence(moves, costs, start_px=16.0, move=2.0)
    assert (cost, gain, margin) == pytest.approx((0.1, 0.4, 0.1))
    assert shift == pytest.approx(2.0 / 4.0)
    assert sharpness == pytest.approx(0.2)


def test_a_search_without_a_rival_or_of_hardly_any_disparity() -> None:
    moves, costs = np.linspace(-0.5, 0.5, 3), np.array([0.9, 0.1, 0.9])
    _, gain, margin, shift, sharpness = match_evidence(moves, costs, start_px=0.5, move=0.0)
    assert (gain, margin, shift, sharpness) == pytest.approx((0.0, MOST_DIFFERENCE, 0.0, MOST_DIFFERENCE))


def test_features_by_name() -> None:
    features = confidence_features(two_cars_and_a_person(), WIDTH)
    assert features.shape == (3, len(FEATURES))
    row = dict(zip(FEATURES, features[1], strict=True))
    assert row["logit"] == pytest.approx(np.log(0.8 / 0.2))
    assert [row[name] for name in EVIDENCE] == [0.1, 0.2, 0.3, 0.4, 0.05, 0.6]
    assert row["log depth"] == pytest.approx(np.log(40.0))
    assert row["log height"] == pytest.approx(np.log(20.0))
    assert [features[index, FEATURES.index("at border")] for index in range(3)] == [0.0, 1.0, 0.0]


def test_a_probability_for_classes_with_weights_and_the_score_for_others() -> None:
    refined = two_cars_and_a_person()
    weights = [0.0] * (len(FEATURES) + 1)
    weights[FEATURES.index("hidden")], weights[-1] = -10.0, 0.5
    found = with_confidence(refined, {"Car": weights}, WIDTH)
    assert list(found.class_id) == [1, 0, 0]  # sorted anew
    expected = [0.7, 1 / (1 + np.exp(-0.5)), 1 / (1 + np.exp(5.5))]
    np.testing.assert_allclose(found.score, expected)
    np.testing.assert_array_equal(found.center_in_camera[:, 2], [12.0, 10.0, 40.0])
    assert with_confidence(refined, {}, WIDTH) is refined.detections


def test_weights_that_do_not_fit() -> None:
    check_confidence({"Car": [0.0] * 11}, ("Car",))
    for weights in ({"Car": [0.0] * 10}, {"Tram": [0.0] * 11}):
        with pytest.raises(ManifestError, match="learn them anew"):
            check_confidence(weights, ("Car", "Pedestrian"))


def test_the_file_and_what_is_none(tmp_path: Path) -> None:
    record = ConfidenceRecord({"Car": tuple(float(number) for number in range(11))}, {"frames": "7"})
    write_confidence(tmp_path / "made" / "c.json", record)
    assert read_confidence(tmp_path / "made" / "c.json") == record
    with pytest.raises(FormatError, match="cannot be read"):
        read_confidence(tmp_path / "none.json")
    for text in ("{", "[]", '{"schema": 1}', '{"schema": 1, "weights": {"Car": [NaN]}, "facts": {}}'):
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(FormatError, match="holds no confidence"):
            read_confidence(tmp_path / "bad.json")
