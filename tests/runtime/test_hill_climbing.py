"""Angles that climb: against recordings of the official code, and what must hold of any box."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from runtime.boxcode import ALPHA, CX, CY, HEIGHT, LENGTH, WIDTH, X1, Y2, Z
from runtime.contracts.manifest import (
    AnchorLayout,
    Crop,
    Manifest,
    NmsPolicy,
    Normalisation,
    RigLimits,
    Thresholds,
    read_priors,
)
from runtime.contracts.objects import box_corners
from runtime.decode import Decoder
from runtime.hill_climbing import FIRST_STEP_RAD, LAST_STEP_RAD, climb, climb_yaw, outline_iou

OFFICIAL_SIZE_HW = (288, 1280)  # written into the official code, whatever the network's
ANGLE_RAD = 1e-9  # float64 against float64
DECODED_RAD = 2e-6  # float32 angles of a few radians
OFFICIAL_FULL_TURNS = (2 * np.pi, 2 * 3.14)  # its two wraps
P2 = np.array([[755.6, 0, 638.4, 47.0], [0, 755.6, 76.3, -0.06], [0, 0, 1, 0.0027]])
LAYOUT = AnchorLayout(ratios=(0.5, 1.0))


def same_angle(found: float, recorded: float, tolerance: float) -> bool:
    """Equal, or apart by one of the recording's two kinds of full turn."""
    apart = abs(found - recorded)
    return min(apart, *(abs(apart - turn) for turn in OFFICIAL_FULL_TURNS)) <= tolerance


def fitting_box(yaw_rad: float, *, x_m: float = 4.0, z_m: float = 18.0) -> np.ndarray:
    """A box whose 2D box is the outline of its 3D box at a yaw; its alpha is that of the yaw."""
    cx, cy = P2[0, 0] * x_m / z_m + P2[0, 2], P2[1, 1] * 1.0 / z_m + P2[1, 2]
    box = np.zeros((1, 11))
    box[0, [CX, CY, Z, WIDTH, HEIGHT, LENGTH]] = cx, cy, z_m, 1.6, 1.5, 4.2
    box[0, ALPHA] = yaw_rad - np.arctan2(cx - P2[0, 2], P2[0, 0])
    center = np.array([[(cx - P2[0, 2]) * z_m / P2[0, 0], (cy - P2[1, 2]) * z_m / P2[1, 1], z_m]])
    corners = box_corners(center, np.array([[1.5, 1.6, 4.2]]), np.array([yaw_rad]))[0]
    pixels = corners[:, :2] / corners[:, 2:] * [P2[0, 0], P2[1, 1]] + [P2[0, 2], P2[1, 2]]
    box[0, X1 : Y2 + 1] = [*pixels.min(axis=0), *pixels.max(axis=0)]
    return box


def test_no_box() -> None:
    nothing = np.zeros((0, 11), np.float32)
    assert climb(nothing, np.zeros(0, bool), P2=P2, size_hw=(288, 1280)).shape == (0, 11)


def test_near_boxes_and_other_classes_stay() -> None:
    boxes = np.concatenate([fitting_box(0.5), fitting_box(0.5), fitting_box(0.5)]).astype(np.float32)
    boxes[:, ALPHA] += 0.3
    boxes[1, Z] = 3.0
    turned = climb(boxes, np.array([True, True, False]), P2=P2, size_hw=(288, 1280))
    assert (turned[:, ALPHA] != boxes[:, ALPHA]).tolist() == [True, False, False]
    np.testing.assert_array_equal(np.delete(turned, ALPHA, axis=1), np.delete(boxes, ALPHA, axis=1))


@pytest.mark.parametrize("yaw_rad", [-2.8, -1.2, -0.4, 0.7, 1.9, 3.0])
def test_a_disturbed_angle_climbs_back(yaw_rad: float) -> None:
    box = fitting_box(yaw_rad)
    assert outline_iou(box, np.array([yaw_rad]), P2=P2, size_hw=(288, 1280))[0] == pytest.approx(1.0)
    found, iou = climb_yaw(box, np.array([yaw_rad + 0.17]), P2=P2, size_hw=(288, 1280))
    assert abs(found[0] - yaw_rad) <= 2 * LAST_STEP_RAD
    before = outline_iou(box, np.array([yaw_rad + 0.17]), P2=P2, size_hw=(288, 1280))
    assert iou[0] > before[0]


def test_boxes_climb_alone_as_together() -> None:
    boxes = np.concatenate([fitting_box(0.3), fitting_box(-1.1, x_m=-6.0, z_m=11.0), fitting_box(2.2, z_m=40.0)])
    start = np.array([0.9, -1.0, 1.7])
    together, _ = climb_yaw(boxes, start, P2=P2, size_hw=(288, 1280))
    alone = [climb_yaw(boxes[i : i + 1], start[i : i + 1], P2=P2, size_hw=(288, 1280))[0][0] for i in range(3)]
    np.testing.assert_array_equal(together, alone)
    assert start.tolist() == [0.9, -1.0, 1.7]


def test_a_box_around_the_camera_stays_finite() -> None:
    box = fitting_box(0.5, z_m=4.0)
    box[0, [WIDTH, LENGTH]] = 30.0
    yaw_rad, iou = climb_yaw(box, np.array([0.5]), P2=P2, size_hw=(288, 1280))
    assert np.isfinite(yaw_rad).all() and np.isfinite(iou).all()


def test_recorded_climbs(golden_dir: Path) -> None:
    facts = json.loads((golden_dir / "hill_climb.json").read_text())
    assert (facts["step_init"], facts["step_limit"]) == (FIRST_STEP_RAD, LAST_STEP_RAD)
    assert len(facts["cases"]) == 24
    projection = np.array(facts["P2"])
    for case in facts["cases"]:
        _, _, depth_m, width, height, length, alpha = case["x_y_z_w_h_l_alpha"]
        box = np.array([[*case["box2d"], case["cx"], case["cy"], depth_m, width, height, length, alpha]])
        ray_rad = np.arctan2(case["cx"] - projection[0, 2], projection[0, 0])
        yaw_rad, iou = climb_yaw(box, np.array([alpha + ray_rad]), P2=projection, size_hw=OFFICIAL_SIZE_HW)
        assert iou[0] == pytest.approx(case["best_iou"], abs=ANGLE_RAD)
        recorded = case["out_cx_cy_z_w_h_l_alpha"][-1]
        # a recorded angle that wrapped both ways is off by the difference of the two turns
        off = [0.0, 2 * np.pi - 2 * 3.14, 2 * 3.14 - 2 * np.pi]
        assert any(same_angle(yaw_rad[0] - ray_rad + shift, recorded, ANGLE_RAD) for shift in off)


def test_recorded_decoding_with_and_without_climbing(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "mono_decode.npz")
    generator = np.random.Generator(np.random.PCG64(71))  # head_predictions(71, 3840, 1, -3.2, 2.0, 3, 0.5)
    cls_logits = (-3.2 + 2.0 * generator.standard_normal((1, 3840, 2))).astype(np.float32)
    cls_logits[..., -1] += 3
    box_deltas = (0.5 * generator.standard_normal((1, 3840, 12))).astype(np.float32)
    priors = read_priors(golden_dir / "mono_priors.npz", ("Car",), LAYOUT)

    def decode(*, hill_climbing: bool) -> np.ndarray:
        manifest = Manifest(
            preset="mono", classes=("Car",), input_size_hw=(96, 320), input_type="float32", views=1,
            crop=Crop("top_rows", 100), normalisation=Normalisation(), anchors=LAYOUT, nms=NmsPolicy(iou=0.5),
            thresholds=Thresholds(0.75, 0.75), rig=RigLimits(250.0, 0.5), hill_climbing=hill_climbing,
        )  # fmt: skip
        decoder = Decoder(manifest, priors)
        assert decoder.usable(recorded["P2"]).any()
        found = decoder.decode_in_network(cls_logits, box_deltas, P2=recorded["P2"], score=0.75)
        np.testing.assert_allclose(found.score, recorded["scores"], atol=1e-6)
        return found.boxes

    before, after = decode(hill_climbing=False), decode(hill_climbing=True)
    np.testing.assert_allclose(before, recorded["boxes_before"], rtol=1e-5, atol=1e-5)
    np.testing.assert_array_equal(after[:, :ALPHA], before[:, :ALPHA])
    official = climb(before, np.ones(len(before), bool), P2=recorded["P2"], size_hw=OFFICIAL_SIZE_HW)
    for ours, theirs in zip(official[:, ALPHA], recorded["boxes_after_hill_climb"][:, ALPHA], strict=True):
        assert same_angle(float(ours), float(theirs), DECODED_RAD)
    # ours cuts at the network's own image: boxes that do not reach its border turn alike
    inside = (before[:, 2] < 320) & (before[:, 3] < 96)
    assert inside.sum() >= 3
    np.testing.assert_array_equal(after[inside, ALPHA], official[inside, ALPHA])
