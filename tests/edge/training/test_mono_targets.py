"""What is particular to training from one view: no claims of low overlap, mirrored alone, alpha from the box."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.training.assign import match_anchors
from edge.training.frame_changes import FrameChanges
from edge.training.ground_truth import alpha_of_yaw, mirror_geometry, mirror_objects, with_every_alpha
from edge.training.priors import anchor_statistics
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry, project_to_image
from runtime.contracts.kitti import MISSING_ALPHA_RAD, parse_labels
from runtime.contracts.manifest import AnchorLayout

P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])
LABEL = "Car 0.00 0 -1.50 300 150 400 200 1.50 1.60 3.90 -6.00 1.60 20.00 -1.80\n"
SHIFT_PX = 0.2  # the mirror leaves t_z (2.7 mm) out, times 1241 columns over 20 m


def test_low_overlap_is_claimed_only_on_demand() -> None:
    anchors = np.array([[0, 0, 10, 10], [100, 0, 110, 10]], np.float32)
    truth = np.array([[4, 0, 14, 10]], np.float32)  # IoU 0.43 with the first anchor
    claimed, _ = match_anchors(anchors, truth, claim_without_overlap=False)
    left, background = match_anchors(anchors, truth, claim_without_overlap=False, low_quality_matches=False)
    assert claimed.tolist() == [0, -2]
    assert left.tolist() == [-1, -2]
    assert background.tolist() == [False, True]


def test_single_view_is_mirrored_with_its_own_camera() -> None:
    geometry = StereoGeometry(P2, P3, (1242, 375))
    mirrored = mirror_geometry(geometry, exchange=False)
    objects = parse_labels(LABEL)
    pixels, _ = project_to_image(geometry.P2, objects.center_in_camera)
    turned = mirror_objects(objects, mirrored.P2)
    turned_pixels, _ = project_to_image(mirrored.P2, turned.center_in_camera)
    np.testing.assert_allclose(turned_pixels, [[1241 - pixels[0, 0], pixels[0, 1]]], atol=SHIFT_PX)


def test_alpha_is_what_decoding_undoes() -> None:
    objects = alpha_of_yaw(parse_labels(LABEL), P2)
    center = objects.center_in_camera[0]
    yaw_rad = objects.alpha_rad[0] + np.arctan2(center[0] + P2[0, 3] / P2[0, 0], center[2])
    assert yaw_rad == pytest.approx(-1.8)
    assert objects.alpha_rad[0] != pytest.approx(-1.5)


def test_an_angle_that_is_not_given_is_what_yaw_says() -> None:
    objects = parse_labels(LABEL + LABEL)
    bare = replace(objects, alpha_rad=np.array([MISSING_ALPHA_RAD, 0.3]))
    filled = with_every_alpha(bare, P2).alpha_rad
    assert filled.tolist() == [alpha_of_yaw(objects, P2).alpha_rad[0], 0.3]
    assert with_every_alpha(objects, P2) is objects


def test_zooming_keeps_an_angle_that_is_not_given_what_yaw_says() -> None:
    objects = parse_labels(LABEL)
    frame = StereoFrame(*[np.zeros((375, 1242, 3), np.uint8)] * 2, 0.0, 0, "0", StereoGeometry(P2, P3, (1242, 375)))
    changes = FrameChanges(zoom=1.0)
    given = changes.of_scene(frame, alpha_of_yaw(objects, P2), seed=0, position=0)[1]
    bare = replace(objects, alpha_rad=np.array([MISSING_ALPHA_RAD]))
    filled = changes.of_scene(frame, bare, seed=0, position=0)[1]
    assert filled.alpha_rad == pytest.approx(given.alpha_rad)
    assert filled.center_in_camera != pytest.approx(objects.center_in_camera)


def test_sizes_that_never_vary_have_a_spread() -> None:
    objects = parse_labels(LABEL)
    frames = [(objects, objects.box_in_left_image)] * 20
    priors = anchor_statistics(frames, ("Car",), AnchorLayout(), input_size_hw=(288, 1280))
    assert (priors.std[..., 3:] > 0).all()
