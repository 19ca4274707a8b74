"""Choosing rows that cover a pool: order, nesting, score."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from calib.coverage import comparable, coverage_order, distances, farthest_order, gap, score
from calib.scene_features import FeatureGroup
from runtime.contracts.errors import FormatError

ORDERS = (coverage_order, farthest_order)
EXACT = 1e-7
"""Distances are rounded to nine decimals and summed over few rows."""

points = hnp.arrays(np.float64, st.tuples(st.integers(1, 25), st.just(3)), elements=st.integers(-5, 5).map(float))


def brute_distances(rows: np.ndarray) -> np.ndarray:
    return np.array([[np.linalg.norm(one - other) for other in rows] for one in rows])


@pytest.mark.parametrize("order", ORDERS)
def test_nothing_and_one(order) -> None:
    assert order(np.zeros((0, 0)), 3) == ()
    assert order(np.zeros((1, 1)), 3) == (0,)
    assert order(np.zeros((4, 4)), 0) == ()


@given(rows=points)
def test_distances_are_those_of_the_rows(rows) -> None:
    np.testing.assert_allclose(distances(rows), brute_distances(rows), atol=1e-6)  # squares cancel


@pytest.mark.parametrize("order", ORDERS)
@given(rows=points, wanted=st.integers(1, 30))
@settings(max_examples=40)
def test_orders_are_distinct_nested_and_repeat(order, rows, wanted) -> None:
    between = distances(rows)
    taken = order(between, wanted)
    assert len(set(taken)) == len(taken) == min(wanted, len(rows))
    assert order(between, len(rows))[: len(taken)] == taken
    assert order(between.copy(), wanted) == taken


@given(rows=points, wanted=st.integers(1, 30))
@settings(max_examples=40)
def test_farthest_takes_the_farthest(rows, wanted) -> None:
    between = distances(rows)
    taken = farthest_order(between, wanted)
    for place in range(1, len(taken)):
        nearest = between[list(taken[:place])].min(axis=0)
        assert nearest[taken[place]] == pytest.approx(nearest.max(), abs=EXACT)


@given(rows=points, wanted=st.integers(2, 6))
@settings(max_examples=40)
def test_farthest_is_within_twice_the_best_gap(rows, wanted) -> None:
    """Gonzalez' bound, against the best of all single replacements and of many random choices."""
    between = distances(rows)
    wanted = min(wanted, len(rows))
    random = np.random.default_rng(0)
    best = min(gap(between, random.choice(len(rows), wanted, replace=False)) for _ in range(50))
    assert gap(between, farthest_order(between, wanted)) <= 2 * best + EXACT


@pytest.mark.parametrize("order", ORDERS)
def test_each_cluster_is_seen_before_any_twice(order) -> None:
    random = np.random.default_rng(1)
    centers = np.array([[0.0, 0.0], [30.0, 0.0], [0.0, 30.0], [30.0, 30.0]])
    # ninety rows of one kind, three of each other: evenly spread choices would hardly see the rare ones
    kinds = np.array([0] * 90 + [1, 2, 3] * 3)
    rows = centers[kinds] + random.normal(0, 0.5, (len(kinds), 2))
    assert {int(kinds[row]) for row in order(distances(rows), 4)} == {0, 1, 2, 3}


def test_the_mean_outweighs_the_odd_one_only_by_coverage() -> None:
    rows = np.array([[value] for value in (*np.linspace(0, 1, 20), *np.linspace(3, 4, 20), 12.0)])
    between = distances(rows)
    assert farthest_order(between, 2)[1] == 40
    assert coverage_order(between, 2)[1] != 40


@given(rows=points)
@settings(max_examples=40)
def test_the_score_rises_from_the_middle_to_one(rows) -> None:
    between = distances(rows)
    order = coverage_order(between, len(rows))
    scores = [score(between, order[:few]) for few in range(1, len(order) + 1)]
    assert all(0.0 <= value <= 1.0 for value in scores)
    assert scores == sorted(scores)
    assert scores[-1] == 1.0
    assert scores[0] == pytest.approx(0.0 if between.max() > 0 else 1.0, abs=EXACT)


def test_each_group_weighs_the_same_and_noise_nothing() -> None:
    random = np.random.default_rng(2)
    groups = (FeatureGroup("one", 1, 0.1), FeatureGroup("many", 4, 0.1), FeatureGroup("flat", 1, 5.0))
    rows = random.normal(0, 10, (400, 6)).astype(np.float32)
    rows[:, 5] = random.normal(0, 0.01, 400)
    squares = comparable(rows, groups).var(axis=0)
    assert squares[0] == pytest.approx(squares[1:5].sum(), rel=0.1)  # 400 random rows, clipped at three deviations
    assert squares[5] < 1e-4


def test_an_odd_value_is_as_odd_as_can_be() -> None:
    rows = np.zeros((50, 1), np.float32)
    rows[7] = 1e6
    assert np.abs(comparable(rows, (FeatureGroup("one", 1, 1.0),))).max() == pytest.approx(3.0)


def test_rows_of_another_width_are_refused() -> None:
    with pytest.raises(FormatError, match=r"found rows of shape \(2, 3\)"):
        comparable(np.zeros((2, 3), np.float32), (FeatureGroup("one", 1, 1.0),))
