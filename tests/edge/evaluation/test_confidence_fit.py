"""What is right, and weights that are found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.evaluation.confidence_fit import fit_confidence, judged_boxes
from runtime.contracts.errors import EdgeError
from runtime.contracts.kitti import parse_labels
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.refinement import FEATURES, Refined, with_confidence

WIDTH = 1000
CLASSES = ("Car", "Pedestrian")


def boxes(center: np.ndarray, class_id: list[int], score: np.ndarray) -> Detections3D:
    count = len(center)
    return Detections3D(
        class_id=class_id,
        score=score,
        box_in_left_image=np.tile([400.0, 100.0, 480.0, 150.0], (count, 1)),
        center_in_camera=center,
        size_hwl=np.tile([1.5, 1.6, 4.0], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=CLASSES,
    )


def truth(center: np.ndarray, class_id: list[int]) -> Objects3D:
    found = boxes(center, class_id, np.ones(len(center)))
    return Objects3D(
        found.class_id,
        found.box_in_left_image,
        found.center_in_camera,
        found.size_hwl,
        found.alpha_rad,
        found.yaw_rad,
        np.zeros(len(center)),
        np.zeros(len(center), np.int64),
        np.full(len(center), -1),
        np.zeros((0, 4)),
        CLASSES,
    )


def test_right_is_the_loosest_overlap_with_a_label_of_the_class() -> None:
    labels = [truth(np.array([[0, 1, 20.0]]), [0]), Objects3D.empty(CLASSES), truth(np.array([[0, 1, 20.0]]), [1])]
    centers = np.array([[0, 1, 20.2], [0, 1, 22.0], [0, 1, 20.0]])  # 80 %, none, the same
    found = [boxes(centers, [0, 0, 1], np.array([0.9, 0.8, 0.7])) for _ in labels]
    assert [list(rows) for rows in judged_boxes(labels, found)] == [[1, 0, 0], [0, 0, 0], [0, 0, 1]]


def test_nobody_can_judge_a_box_over_a_region_without_labels_or_over_a_van() -> None:
    van = "Van 0 0 0 400 100 480 150 2.0 1.8 4.5 0 1 40 0"
    region = "DontCare -1 -1 -10 390 90 500 160 -1 -1 -1 -1000 -1000 -1000 -10"
    right = "Car 0 0 0 400 100 480 150 1.5 1.6 4.0 0 1.75 20 0"
    for text, expected in (
        (van, [np.nan, np.nan, 0]),
        (region, [np.nan] * 3),
        (f"{right}\n{region}", [1, np.nan, np.nan]),
    ):
        found = boxes(np.array([[0, 1, 20.0], [0, 1, 30.0], [0, 1, 20.0]]), [0, 0, 1], np.full(3, 0.8))
        np.testing.assert_array_equal(judged_boxes([parse_labels(text)], [found])[0], expected)


def drawn(frames: int) -> tuple[list[Refined], list[Objects3D]]:
    """Frames of ten cars whose depth is off the more often the worse they match; scores know nothing of it."""
    rng = np.random.default_rng(3)
    found, labels = [], []
    for _ in range(frames):
        cost = rng.uniform(0.0, 1.0, 10)
        wrong = rng.uniform(size=10) < 1.0 / (1.0 + np.exp(-(12.0 * cost - 6.0)))
        place = np.stack([np.zeros(10), np.ones(10), 10.0 + 10.0 * np.arange(10)], axis=1)
        seen = boxes(place + np.outer(wrong, [0.0, 0.0, 3.0]), [0] * 10, np.full(10, 0.8))
        evidence = np.zeros((10, 6))
        evidence[:, 0] = cost
        found.append(Refined(seen, evidence))
        labels.append(truth(place, [0] * 10))
    return found, labels


def test_weights_follow_what_tells_right_from_wrong() -> None:
    found, labels = drawn(200)
    fit = fit_confidence(found, labels, [WIDTH] * 200, "Car")
    weights = dict(zip(FEATURES, fit.weights, strict=False))
    assert weights["cost"] == pytest.approx(-12.0, rel=0.15)
    assert abs(weights["log depth"]) < 0.5 and abs(weights["shift"]) < 1e-6
    assert fit.boxes == 2000 and 800 < fit.right < 1200
    assert fit.loss_after < 0.6 * fit.loss_before
    told = 1 / (1 + np.exp(-(-12.0 * 0.5 + fit.weights[-1] + weights["log depth"] * np.log(50.0)
                             + weights["log height"] * np.log(50.0) + weights["logit"] * np.log(4.0))))  # fmt: skip
    assert told == pytest.approx(0.5, abs=0.06)


def test_what_the_fit_is_judged_by_is_what_models_say_of_doubted_boxes() -> None:
    found, labels = drawn(200)
    doubted = [
        replace(item, detections=replace(item.detections, score=item.detections.score / 2)) for item in found
    ]  # 0.4
    fit = fit_confidence(doubted, labels, [WIDTH] * 200, "Car")
    said = [with_confidence(item, {"Car": fit.weights}, WIDTH) for item in doubted]
    told = np.concatenate([item.score for item in said])
    right = np.concatenate(judged_boxes(labels, said)) > 0
    assert told.max() <= 0.4
    assert fit.loss_after == pytest.approx(-np.log(np.where(right, told, 1 - told)).mean(), rel=0.02)


def test_too_little_to_learn_from() -> None:
    found, labels = drawn(4)
    with pytest.raises(EdgeError, match=r"right and .* wrong boxes of Car, expected at least 50"):
        fit_confidence(found, labels, [WIDTH] * 4, "Car")
    with pytest.raises(EdgeError, match="found 0 right"):
        fit_confidence(found, labels, [WIDTH] * 4, "Pedestrian")
