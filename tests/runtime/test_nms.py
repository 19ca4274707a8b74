"""Greedy suppression."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.candidates import Thinning
from runtime.nms import iou_one_to_many, non_maximum_suppression

Suppress = Callable[..., np.ndarray]


@pytest.fixture(params=["numpy", "native"])
def suppress(request: pytest.FixtureRequest) -> Suppress:
    """Both ways to thin boxes."""
    found: Thinning = Thinning() if request.param == "numpy" else request.getfixturevalue("native_thinning")
    return found.suppress


def test_no_boxes(suppress: Suppress) -> None:
    assert suppress(np.zeros((0, 4)), np.zeros(0), 0.5).shape == (0,)


def test_overlap_of_known_boxes() -> None:
    box = np.array([0.0, 0, 10, 10])
    others = np.array([[0.0, 0, 10, 10], [5, 0, 15, 10], [20, 20, 30, 30], [3, 3, 3, 3]])
    np.testing.assert_allclose(iou_one_to_many(box, others), [1, 1 / 3, 0, 0])


def test_groups_do_not_suppress_each_other(suppress: Suppress) -> None:
    boxes = np.array([[0.0, 0, 10, 10], [0, 0, 10, 10], [1, 0, 11, 10]])
    scores = np.array([0.9, 0.8, 0.7])
    assert list(suppress(boxes, scores, 0.5)) == [0]
    assert list(suppress(boxes, scores, 0.5, groups=np.array([0, 1, 0]))) == [0, 1]


def test_groups_suppress_each_other_at_one_depth(suppress: Suppress) -> None:
    """A rider before a car: the car behind and another rider behind it stay or go by class and depth."""
    boxes = np.array([[0.0, 0, 10, 10]] * 4)
    scores, groups = np.array([0.9, 0.8, 0.7, 0.6]), np.array([0, 1, 0, 1])
    depths = np.array([10.0, 18.0, 18.0, 11.0])
    kept = suppress(boxes, scores, 0.5, groups=groups, depths=depths, depth_share=0.15)
    assert list(kept) == [0, 1]
    assert list(suppress(boxes[:2], scores[:2], 0.5, groups=groups[:2])) == [0, 1]


def test_equal_scores_keep_the_first(suppress: Suppress) -> None:
    boxes = np.array([[0.0, 0, 10, 10], [0, 0, 10, 10]])
    assert list(suppress(boxes, np.array([0.5, 0.5]), 0.5)) == [0]


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.integers(1, 40), st.integers(0, 2**31 - 1), st.sampled_from([0.3, 0.5, 0.7]))
def test_idempotent_and_kept_boxes_are_apart(suppress: Suppress, count: int, seed: int, iou: float) -> None:
    rng = np.random.default_rng(seed)
    lower = rng.uniform(0, 50, (count, 2))
    boxes = np.concatenate([lower, lower + rng.uniform(1, 30, (count, 2))], axis=1)
    scores = rng.uniform(0, 1, count)
    kept = suppress(boxes, scores, iou)
    assert scores[kept][0] == scores.max()
    assert np.all(np.diff(scores[kept]) <= 0)
    for position, index in enumerate(kept):
        assert np.all(iou_one_to_many(boxes[index], boxes[kept[position + 1 :]]) <= iou)
    again = suppress(boxes[kept], scores[kept], iou)
    np.testing.assert_array_equal(again, np.arange(len(kept)))


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 200), st.integers(0, 2**31 - 1), st.sampled_from(["all", "groups", "depths"]))
def test_the_library_keeps_what_numpy_keeps(native_thinning: Thinning, count: int, seed: int, rivals: str) -> None:
    """Boxes of whole pixels: ties of scores, overlaps of just the threshold; some have no size or no number."""
    rng = np.random.default_rng(seed)
    lower = rng.integers(0, 20, (count, 2)).astype(np.float64)
    boxes = np.concatenate([lower, lower + rng.integers(0, 12, (count, 2))], axis=1)
    boxes[rng.uniform(size=count) < 0.05, 2] = np.nan
    boxes[rng.uniform(size=count) < 0.05, 3] = np.inf
    scores = rng.integers(1, 10, count) / 10
    groups = None if rivals == "all" else rng.integers(0, 3, count)
    depths = rng.uniform(5, 20, count) if rivals == "depths" else None
    with np.errstate(invalid="ignore"):
        expected = non_maximum_suppression(boxes, scores, 0.5, groups=groups, depths=depths, depth_share=0.15)
    found = native_thinning.suppress(boxes, scores, 0.5, groups=groups, depths=depths, depth_share=0.15)
    np.testing.assert_array_equal(found, expected)
