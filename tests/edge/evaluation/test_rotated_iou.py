"""Rotated overlap against shapely, against recorded exact values, and by its properties."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from shapely.geometry import Polygon

from edge.evaluation.rotated_iou import intersection_areas
from edge.evaluation.tables import solid_overlap
from runtime.contracts.objects import ground_corners

EXACT_TOLERANCE = 1e-12  # of values up to 1: a few dozen float64 roundings
AREA_TOLERANCE = 1e-9  # of areas up to 400 square metres, shapely's own rounding included

coordinate = st.floats(-10.0, 10.0, allow_nan=False)
side = st.floats(0.05, 20.0)
angle = st.one_of(st.floats(-7.0, 7.0), st.sampled_from([0.0, np.pi / 2, -np.pi / 2, np.pi, np.pi / 4]))
rectangle = st.tuples(coordinate, coordinate, side, side, angle)


def rotated_iou(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Of each pair on the ground: seen from above, the overlap of solids of whatever height."""
    seen_from_above, _ = solid_overlap(*(np.pad(boxes, ((0, 0), (0, 2))) for boxes in (first, second)))
    return seen_from_above


def test_no_pairs():
    none = np.zeros((0, 5))
    assert rotated_iou(none, none).shape == (0,)


def test_rectangle_without_area_shares_nothing():
    flat = np.array([[0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, -1.0, -1.0, 0.0]])
    solid = np.array([[0.0, 0.0, 4.0, 2.0, 0.0]] * 2)
    assert rotated_iou(flat, solid).tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ((0.0, 0.0, 4.0, 2.0, 0.0), 1.0),  # the same
        ((0.0, 0.0, 4.0, 2.0, np.pi), 1.0),  # turned about
        ((0.0, 0.0, 2.0, 4.0, np.pi / 2), 1.0),  # length and width exchanged, turned back
        ((0.0, 0.0, 2.0, 1.0, 0.0), 0.25),  # inside
        ((4.0, 0.0, 4.0, 2.0, 0.0), 0.0),  # touching
        ((2.0, 0.0, 4.0, 2.0, 0.0), 1.0 / 3.0),  # half
        ((0.0, 0.0, 4.0, 2.0, np.pi / 2), 4.0 / 12.0),  # crossing
    ],
)
def test_known_overlaps(other: tuple[float, ...], expected: float):
    base = np.array([[0.0, 0.0, 4.0, 2.0, 0.0]])
    for yaw in (0.0, 0.3, 1.2, -2.5):
        turn = np.array([[0.0, 0.0, 0.0, 0.0, yaw]])
        offset_x, offset_z = other[0] * np.cos(yaw), -other[0] * np.sin(yaw)
        moved = np.array([[offset_x, offset_z, *other[2:]]]) + turn
        assert rotated_iou(base + turn, moved)[0] == pytest.approx(expected, abs=EXACT_TOLERANCE)


def test_recorded_exact_values(golden_dir: Path):
    with np.load(golden_dir / "eval" / "rotated_iou.npz") as recorded:
        first, second = recorded["boxes_x_z_l_w_ry"], recorded["queries"]
        expected = recorded["iou_exact_shapely"]
    rows, columns = np.divmod(np.arange(expected.size), len(second))
    got = rotated_iou(first[rows], second[columns]).reshape(expected.shape)
    np.testing.assert_allclose(got, expected, rtol=0, atol=EXACT_TOLERANCE)


@settings(max_examples=200, deadline=None)
@given(first=rectangle, second=rectangle)
def test_area_equals_shapely(first: tuple[float, ...], second: tuple[float, ...]):
    pair = np.array([first, second])
    polygons = [Polygon(corners) for corners in ground_corners(pair[:, :2], pair[:, 2:4], pair[:, 4])]
    expected = polygons[0].intersection(polygons[1]).area
    assert intersection_areas(pair[:1], pair[1:])[0] == pytest.approx(expected, abs=AREA_TOLERANCE)


@settings(max_examples=100, deadline=None)
@given(first=rectangle, second=rectangle)
def test_symmetric_and_bounded(first: tuple[float, ...], second: tuple[float, ...]):
    one, two = np.array([first]), np.array([second])
    forth, back = rotated_iou(one, two)[0], rotated_iou(two, one)[0]
    assert forth == pytest.approx(back, abs=EXACT_TOLERANCE)
    assert 0.0 <= forth <= 1.0 + EXACT_TOLERANCE
    assert rotated_iou(one, one)[0] == pytest.approx(1.0, abs=EXACT_TOLERANCE)
