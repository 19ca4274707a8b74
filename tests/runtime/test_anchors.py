"""Anchors and the ground-plane filter against the recorded ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from runtime.anchors import anchor_grid, anchor_shapes, usable_anchors, usable_by_class
from runtime.contracts.manifest import AnchorLayout, AnchorPriors, read_priors

GRID_TOLERANCE_PX = 1e-12  # the recording is the same float32 arithmetic


def test_no_cell_gives_no_anchor() -> None:
    assert anchor_grid(AnchorLayout(), (8, 8)).boxes.shape == (0, 4)


def test_order_is_rows_columns_ratios_scales() -> None:
    layout = AnchorLayout(base_px=16, scales_per_octave=1, scale_count=2, ratios=(1.0, 4.0))
    grid = anchor_grid(layout, (32, 48))
    assert len(grid.boxes) == 2 * 3 * 4
    np.testing.assert_allclose(grid.center_xy[:4], [[8, 8]] * 4)
    np.testing.assert_allclose(grid.center_xy[4], [24, 8])
    np.testing.assert_allclose(grid.size_wh[:4], [[16, 16], [32, 32], [8, 32], [16, 64]])
    assert list(grid.shape_index[:5]) == [0, 1, 2, 3, 0]


def test_shapes_keep_area_and_ratio() -> None:
    layout = AnchorLayout()
    width, height = anchor_shapes(layout).T
    np.testing.assert_allclose(height / width, np.repeat(layout.ratios, layout.scale_count))
    np.testing.assert_allclose(width[:16] * height[:16], (24 * 2 ** (np.arange(16) / 4)) ** 2)


def test_filter_keeps_what_any_class_can_stand_on() -> None:
    layout = AnchorLayout(base_px=16, scales_per_octave=1, scale_count=1, ratios=(1.0,))
    grid = anchor_grid(layout, (64, 32))
    mean = np.full((2, 1, 1, 6), -100.0, np.float32)
    mean[1, ..., 0] = 10.0  # only the second class has a depth
    priors = AnchorPriors(mean, np.ones_like(mean))
    P2 = np.array([[100.0, 0, 16, 0], [0, 100, 32, 0], [0, 0, 1, 0]])
    kept = usable_anchors(grid, layout, priors=priors, P2=P2).reshape(4, 2)
    # rows 8, 24, 40, 56: Y at 10 m = -2.4, -0.8, 0.8, 2.4; at the unusable -100 m = 24, 8, -8, -24
    np.testing.assert_array_equal(kept.all(axis=1), [False, False, True, False])


def test_filter_tells_the_classes_apart() -> None:
    layout = AnchorLayout(base_px=16, scales_per_octave=1, scale_count=1, ratios=(1.0,))
    grid = anchor_grid(layout, (64, 32))
    mean = np.zeros((2, 1, 1, 6), np.float32)
    mean[:, 0, 0, 0] = [10.0, 2.0]
    P2 = np.array([[100.0, 0, 16, 0], [0, 100, 32, 0], [0, 0, 1, 0]])
    priors = AnchorPriors(mean, np.ones_like(mean))
    kept = usable_by_class(grid, layout, priors=priors, P2=P2).reshape(2, 4, 2)
    # rows 8, 24, 40, 56: Y at 10 m = -2.4, -0.8, 0.8, 2.4; at 2 m = -0.48, -0.16, 0.16, 0.48
    np.testing.assert_array_equal(kept.all(axis=2), [[False, False, True, False], [True] * 4])
    np.testing.assert_array_equal(usable_anchors(grid, layout, priors=priors, P2=P2), kept.any(axis=0).ravel())


def test_recorded_anchors(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "anchors.npz")
    layout = AnchorLayout()
    grid = anchor_grid(layout, (96, 320))
    np.testing.assert_allclose(grid.boxes, recorded["anchors_96x320"], atol=GRID_TOLERANCE_PX, rtol=0)
    half = anchor_shapes(layout) / 2
    np.testing.assert_allclose(np.concatenate([-half, half], axis=1), recorded["base_anchors_48"], atol=1e-12, rtol=0)


def test_recorded_filter(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "anchors.npz")
    layout = AnchorLayout()
    priors = read_priors(golden_dir / "priors.npz", ("Car", "Pedestrian"), layout)
    small = recorded["P2_96x320"]
    full = small.copy()
    full[:2] *= 3
    full[0, 2] = 609.5593 * 288 / 275
    for size_hw, P2 in (((96, 320), small), ((288, 1280), full)):
        grid = anchor_grid(layout, size_hw)
        bits = np.unpackbits(recorded[f"mask_{size_hw[0]}x{size_hw[1]}"])[: len(grid.boxes)].astype(bool)
        np.testing.assert_array_equal(usable_anchors(grid, layout, priors=priors, P2=P2), bits)
