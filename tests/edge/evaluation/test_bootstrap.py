"""The paired bootstrap: exact on equal models, reproducible, and it sees a real loss."""

from __future__ import annotations

import numpy as np
import pytest

from edge.evaluation.bootstrap import ap_drop, ap_interval95, frame_weights
from edge.evaluation.kitti_ap import Evaluation, evaluate
from runtime.contracts.errors import FormatError
from runtime.contracts.kitti import parse_detections, parse_labels

FRAMES = 30


def line(x: float, score: float | None = None, shift: float = 0.0) -> str:
    left = 600.0 + 36.0 * x
    text = f"Car 0.00 0 0.10 {left} 150.00 {left + 120.0} 220.00 1.50 1.60 3.90 {x + shift} 1.60 20.00 0.30"
    return text if score is None else f"{text} {score}"


def model(*, found_share: float, shift: float, seed: int = 0) -> Evaluation:
    generator = np.random.default_rng(seed)
    places = (-8.0, 0.0, 8.0)
    labels = [parse_labels("\n".join(line(x) for x in places)) for _ in range(FRAMES)]
    found = []
    for _ in range(FRAMES):
        lines = [
            line(x, score=round(generator.uniform(0.1, 1.0), 3), shift=shift * generator.normal())
            for x in places
            if generator.random() < found_share
        ]
        found.append(parse_detections("\n".join(lines)))
    return evaluate(labels, found, ["Car"])


def test_weights_of_no_frames():
    assert frame_weights(0, draws=5).shape == (5, 0)


def test_weights_are_draws_with_replacement_and_repeat():
    weights = frame_weights(7, draws=100)
    assert (weights.sum(axis=1) == 7).all()
    np.testing.assert_array_equal(weights, frame_weights(7, draws=100))


def test_equal_models_lose_nothing():
    one = model(found_share=0.8, shift=0.3)
    draws = one.draws(frame_weights(FRAMES, draws=50))
    drop = ap_drop(one, one, reference_draws=draws, other_draws=draws)
    for metric in ("2d", "bev", "3d", "aos"):
        for overlap, points in drop.points["Car"][metric].items():
            assert points == {"R40": [0.0] * 3, "R11": [0.0] * 3}
            assert drop.interval95["Car"][metric][overlap]["R40"] == [[0.0, 0.0]] * 3


def test_a_clear_loss_has_an_interval_above_zero():
    good, bad = model(found_share=1.0, shift=0.05), model(found_share=0.4, shift=0.6)
    weights = frame_weights(FRAMES)
    drop = ap_drop(good, bad, reference_draws=good.draws(weights), other_draws=bad.draws(weights))
    point = drop.points["Car"]["3d"]["0.5"]["R40"][1]
    low, high = drop.interval95["Car"]["3d"]["0.5"]["R40"][1]
    assert 0.0 < low < point < high
    assert point == pytest.approx(good.ap()["Car"]["3d"]["0.5"]["R40"][1] - bad.ap()["Car"]["3d"]["0.5"]["R40"][1])


def test_interval_narrows_with_pairing():
    # two models that differ in little: the paired interval is narrower than either model's own
    good, worse = model(found_share=0.7, shift=0.2), model(found_share=0.7, shift=0.25)
    weights = frame_weights(FRAMES, draws=300)
    first, second = good.draws(weights), worse.draws(weights)
    paired = ap_drop(good, worse, reference_draws=first, other_draws=second)
    low, high = paired.interval95["Car"]["2d"]["0.7"]["R40"][1]
    own_low, own_high = ap_interval95(good, first)["Car"]["2d"]["0.7"]["R40"][1]
    assert high - low < own_high - own_low


def test_different_frames_are_refused():
    one = model(found_share=0.8, shift=0.3)
    with pytest.raises(FormatError, match="same frames"):
        ap_drop(one, evaluate([], []), reference_draws={}, other_draws={})
