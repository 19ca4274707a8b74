"""AP by distance: each band judges its own objects alone."""

from __future__ import annotations

import numpy as np
import pytest

from edge.evaluation.distance import ap_by_distance
from runtime.contracts.kitti import parse_labels
from runtime.contracts.objects import Detections3D

NAMES = ("Car", "Pedestrian")
NEAR, FAR = "Car 0 0 0 100 100 200 160 1.5 1.6 3.9 -2 1.6 10 0", "Car 0 0 0 300 100 360 140 1.5 1.6 3.9 3 1.6 35 0"
FRAMES = 41  # fewer objects than recall points cannot reach 100 by the development kit


def found(*rows: tuple[float, float, float, float]) -> Detections3D:
    """Cars by left and right edge (px), lateral place and depth (m)."""
    count = len(rows)
    left, right, x, z = (np.array(values) for values in zip(*rows, strict=True)) if rows else (np.zeros(0),) * 4
    bottom = np.where(z < 20, 160.0, 140.0)
    return Detections3D(
        class_id=np.zeros(count, int),
        score=np.full(count, 0.9),
        box_in_left_image=np.column_stack([left, np.full(count, 100.0), right, bottom]),
        center_in_camera=np.column_stack([x, np.full(count, 1.6 - 0.75), z]),
        size_hwl=np.tile([1.5, 1.6, 3.9], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=NAMES,
    )


def test_a_lost_far_car_costs_its_own_band_alone() -> None:
    labels = [parse_labels(f"{NEAR}\n{FAR}\n") for _ in range(FRAMES)]
    near, far = (100.0, 200.0, -2.0, 10.0), (300.0, 360.0, 3.0, 35.0)
    rows = ap_by_distance(labels, [found(near, far)] * FRAMES, [found(near)] * FRAMES, NAMES)
    assert [(row.name, row.band, row.objects) for row in rows] == [("Car", "0-15", FRAMES), ("Car", "30-45", FRAMES)]
    assert [row.reference for row in rows] == pytest.approx([100.0, 100.0])
    assert [row.other for row in rows] == pytest.approx([100.0, 0.0])
    assert [row.drop for row in rows] == pytest.approx([0.0, 100.0])
