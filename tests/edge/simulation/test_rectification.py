"""What rectification leaves over: without error nothing, at worst about a pixel of rows, hardly any columns."""

from __future__ import annotations

import numpy as np
import pytest

from edge.simulation.rectification import WORST_ROWS_PX, RectificationError
from edge.simulation.rig import kitti_rig

SIZE_WH = (120, 60)
DRAWS = 400
BEYOND_WORST_PX = 0.6  # roll and stretch add to the shift in the corners: three standard deviations of theirs
WORST_COLUMNS_PX = 0.3  # 0.15 of shift, the rest from roll at the upper and lower edge
CENTROID_TOLERANCE_PX = 0.05  # a blob of a few pixels, sampled bilinearly, with float32 weights of 1/32 pixel


def test_no_error_changes_nothing() -> None:
    radiance = np.random.default_rng(0).random((60, 120, 3), np.float32)
    assert RectificationError().apply(radiance) is radiance


def test_what_is_drawn_moves_as_the_error_says() -> None:
    rows, columns = np.mgrid[0:60, 0:120].astype(np.float32)
    error = RectificationError(rows_px=0.7, columns_px=-0.2, roll_rad=2e-3, stretch=1e-3)
    for x, y in ((20.0, 12.0), (60.0, 30.0), (101.0, 47.0)):
        blob = np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / 8.0)
        moved = error.apply(np.repeat(blob[..., None], 3, axis=2))[..., 1]
        centre = np.array([(columns * moved).sum(), (rows * moved).sum()]) / moved.sum()
        assert centre == pytest.approx(error.moved(np.array([x, y]), SIZE_WH), abs=CENTROID_TOLERANCE_PX)


def test_drawn_errors_stay_within_a_pixel_or_so_and_leave_disparity_alone() -> None:
    rng, size_wh = np.random.default_rng(3), kitti_rig().image_size_wh
    corners = np.array([[x, y] for x in (0.0, size_wh[0] - 1.0) for y in (0.0, size_wh[1] - 1.0)])
    moves = np.array([RectificationError.draw(rng).moved(corners, size_wh) - corners for _ in range(DRAWS)])
    rows = np.abs(moves[..., 1]).max(axis=1)
    assert rows.max() < WORST_ROWS_PX + BEYOND_WORST_PX
    assert np.median(rows) > 0.1  # there is an error at all
    assert np.abs(moves[..., 0]).max() < WORST_COLUMNS_PX
