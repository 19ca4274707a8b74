"""Mirrored pairs, label projection, grey images, disparity maps, gradients and flaws: each equals its recording."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.presets import preset  # noqa: E402
from edge.training.assign import assign, match_anchors  # noqa: E402
from edge.training.augment import draw_colour_change  # noqa: E402
from edge.training.disparity_targets import (  # noqa: E402
    block_matching_disparity,
    disparity_from_points,
    official_grey,
)
from edge.training.ground_truth import (  # noqa: E402
    GroundTruth,
    ObjectLimits,
    ground_truth,
    mirror_geometry,
    mirror_objects,
)
from edge.training.losses import disparity_loss, focal_terms  # noqa: E402
from runtime.anchors import anchor_grid, usable_anchors  # noqa: E402
from runtime.boxcode import ALPHA  # noqa: E402
from runtime.contracts.geometry import StereoGeometry, back_project, project_to_image  # noqa: E402
from runtime.contracts.kitti import parse_labels  # noqa: E402
from runtime.contracts.manifest import AnchorLayout, read_priors  # noqa: E402
from runtime.contracts.objects import box_corners, wrap_angle_rad  # noqa: E402
from runtime.preprocess import network_view, normalise, to_network_image, to_planes  # noqa: E402

pytestmark = pytest.mark.torch

CLASSES = ("Car", "Pedestrian")
GEOMETRY_TOLERANCE = 1e-9  # the same double arithmetic in another order
BOX_TOLERANCE_PX = 5e-4  # the recording's corners are float32, up to a thousand pixels
ANGLE_TOLERANCE_RAD = 1e-9
TARGET_TOLERANCE = 1e-4  # float32 columns of up to a thousand pixels
GRADIENT_TOLERANCE = 1e-5  # of the largest gradient; (1 - p)^-5 magnifies float32 rounding
PIXEL_TOLERANCE = 1e-5  # normalised float32
CHECKSUM_TOLERANCE = 1e-2  # a million float32 values of up to 2.6
PREPARED_SEED = 3000
SLICE_ROWS = slice(None, None, 24)  # the recording keeps every 24th row
NONE = np.zeros((0, 4), np.float32)
SCANNER_IN_CAMERA_M = np.array([0.0, -0.08, -0.27])  # the recording's scanner: KITTI's axes, no turn


@pytest.fixture
def facts(golden_dir: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((golden_dir / "data_pipeline.json").read_text())
    return content


@pytest.fixture
def recorded(reference_dir: Path) -> Any:
    return np.load(reference_dir / "data_pipeline.npz")


def geometry_of(facts: dict[str, Any], suffix: str = "") -> StereoGeometry:
    return StereoGeometry(np.array(facts[f"P2{suffix}"]), np.array(facts[f"P3{suffix}"]), (1280, 288))


def test_mirrored_geometry_and_labels(facts: dict[str, Any]) -> None:
    mirror = facts["mirror"]
    mirrored = mirror_geometry(geometry_of(mirror, "_in"))
    np.testing.assert_allclose(mirrored.P2, mirror["P2_out"], atol=GEOMETRY_TOLERANCE)
    np.testing.assert_allclose(mirrored.P3, mirror["P3_out"], atol=GEOMETRY_TOLERANCE)
    objects = mirror_objects(parse_labels("".join(f"{line}\n" for line in mirror["labels_in"])), mirrored.P2)
    for row, expected in enumerate(mirror["labels_out"]):
        x, y, z = objects.center_in_camera[row]
        assert (x, z) == (expected["x"], expected["z"])
        assert y + expected["h"] / 2 == pytest.approx(expected["y"], abs=GEOMETRY_TOLERANCE)
        for ours, theirs in ((objects.yaw_rad[row], expected["ry"]), (objects.alpha_rad[row], expected["alpha"])):
            # the recording is not wrapped
            assert ours == pytest.approx(float(wrap_angle_rad(np.array(theirs))), abs=ANGLE_TOLERANCE_RAD)
    again = mirror_geometry(mirrored)
    np.testing.assert_allclose(again.P2, mirror["P2_in"], atol=GEOMETRY_TOLERANCE)


def test_mirrored_pixels_exchange_the_views(recorded: Any) -> None:
    np.testing.assert_array_equal(recorded["mirror_left_out"], recorded["mirror_right_in"][:, ::-1])
    np.testing.assert_array_equal(recorded["mirror_right_out"], recorded["mirror_left_in"][:, ::-1])


@pytest.mark.parametrize("mirrored", [False, True])
def test_labels_become_targets(facts: dict[str, Any], mirrored: bool) -> None:
    case = facts["labels_to_targets"][mirrored]
    assert case["mirror"] is mirrored
    geometry = geometry_of(case)
    objects = parse_labels("".join(f"{line}\n" for line in case["labels_in"]))
    if mirrored:
        objects = mirror_objects(objects, geometry.P2)
    truth = ground_truth(objects, CLASSES, geometry=geometry, limits=ObjectLimits(), dont_care_in_network=NONE)
    np.testing.assert_allclose(truth.boxes[:, :4], case["bbox2d"], atol=BOX_TOLERANCE_PX)
    expected = np.array(case["cx_cy_z_w_h_l_alpha"])
    expected[:, -1] = wrap_angle_rad(expected[:, -1])
    np.testing.assert_allclose(truth.boxes[:, 4:], expected, atol=TARGET_TOLERANCE)
    np.testing.assert_array_equal(truth.class_index, [0, 1, 0])
    np.testing.assert_allclose(truth.boxes[:, ALPHA], expected[:, -1], atol=TARGET_TOLERANCE)


def test_projection_and_back(recorded: Any) -> None:
    P2, state, placed = recorded["proj_P2"], recorded["proj_state"], recorded["proj_xyz_state"]
    points = back_project(P2, state[:, :2], state[:, 2] + P2[2, 3])  # official: z is the reference camera's
    np.testing.assert_allclose(points[:, 2], placed[:, 2], atol=GEOMETRY_TOLERANCE)
    x = (state[:, 0] * state[:, 2] - P2[0, 2] * state[:, 2] - P2[0, 3]) / P2[0, 0]
    np.testing.assert_allclose(x, placed[:, 0], atol=GEOMETRY_TOLERANCE)
    theta = state[:, 6] + np.arctan2(placed[:, 0] + P2[0, 3] / P2[0, 0], placed[:, 2])
    np.testing.assert_allclose(theta, recorded["proj_theta"], atol=1e-6)
    corners = box_corners(placed[:, :3], placed[:, [4, 3, 5]], recorded["proj_theta"])
    np.testing.assert_allclose(corners, recorded["proj_corners"], atol=1e-6)
    pixels, _ = project_to_image(P2, recorded["proj_corners"])
    # the official code divides by depth + 1e-6
    np.testing.assert_allclose(pixels, recorded["proj_image_corners"][..., :2], atol=1e-3)


def banded_pair(module: ModuleType, case: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The recording's pair: its disparity is the same over bands of rows."""
    (height, width), band = case["size"], case["band"]
    margin = module.MARGIN_PX
    draw = np.random.Generator(np.random.PCG64(case["image_seed"]))
    texture = draw.integers(0, 256, (height, width + 2 * margin, 3)).astype(np.float64)
    for axis in (0, 1):
        texture = sum(np.roll(texture, step, axis) for step in (-2, -1, 0, 1, 2)) / 5
    texture = np.floor(np.clip((texture - 127.5) * 2.5 + 127.5, 0, 255)).astype(np.uint8)
    begins = margin + 4 + (np.arange(height) // band * band * 40) // height
    right = np.stack([texture[row, begin : begin + width] for row, begin in enumerate(begins)])
    return texture[:, margin : margin + width].copy(), right


def test_official_grey_and_matching(
    recorded: Any, facts: dict[str, Any], golden_module: Callable[[str], ModuleType]
) -> None:
    case = facts["stereo_bm"]
    left, right = banded_pair(golden_module("network/recorded_case.py"), case)
    greys = [official_grey(image[..., ::-1], preset("paper").normalisation) for image in (left, right)]
    np.testing.assert_array_equal(greys[0], recorded["bm_gray_left"])
    np.testing.assert_array_equal(greys[1], recorded["bm_gray_right"])
    found = block_matching_disparity(*greys)
    np.testing.assert_array_equal(found * 16, recorded["bm_reduced_left"])
    flipped = [np.ascontiguousarray(grey[:, ::-1]) for grey in reversed(greys)]
    np.testing.assert_array_equal(block_matching_disparity(*flipped) * 16, recorded["bm_reduced_right_of_flipped"])


def test_disparity_from_points(recorded: Any) -> None:
    x, y, z = recorded["velo_points"].T
    points = np.stack([-y, -z, x], axis=1) + SCANNER_IN_CAMERA_M
    scale = 288 / 275
    P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 72.854, -0.0582093], [0, 0, 1, 0.002745884]])
    P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 72.854, 1.9269455], [0, 0, 1, 0.002729905]])
    P2[:2] *= scale
    P3[:2] *= scale
    found = disparity_from_points(points, StereoGeometry(P2, P3, (1280, 288)))
    rows, columns = recorded["velo_nz"]
    np.testing.assert_array_equal(np.stack(np.nonzero(found)), np.stack([rows, columns]))
    ours, theirs = found[rows, columns].astype(int), recorded["velo_val"].astype(int)
    differ = np.flatnonzero(ours != theirs)
    # two points share one pixel: the recording keeps the later, we the nearer; one value lies on a sixteenth's edge
    assert len(differ) <= 2 and (ours[differ] > theirs[differ]).all()
    P3[0, 2] -= 0.5  # of cameras whose principal columns differ by half a pixel
    farther = disparity_from_points(points, StereoGeometry(P2, P3, (1280, 288)))[rows, columns].astype(int)
    assert set(farther - ours) == {8}


@pytest.mark.parametrize("coefficient", [1, 5])
def test_gradient_of_the_stereo_focal_loss(reference_dir: Path, coefficient: int) -> None:
    recorded = np.load(reference_dir / "loss_disparity.npz")
    logits = torch.tensor(recorded["logits"], requires_grad=True)
    disparity_loss(logits, torch.tensor(recorded["gt"]), focal_coefficient=coefficient).backward()
    expected = recorded[f"grad_focal_coefficient_{coefficient}"]
    assert logits.grad is not None
    difference = np.abs(logits.grad.numpy()[:, ::8] - expected).max()
    assert difference <= GRADIENT_TOLERANCE * np.abs(expected).max()


def test_object_outside_the_image(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "assign_targets.npz")
    expected = json.loads((golden_dir / "head_and_losses.json").read_text())["assign_img1_with_outside_gt"]
    layout = AnchorLayout()
    priors = read_priors(golden_dir / "priors.npz", CLASSES, layout)
    grid = anchor_grid(layout, (288, 1280))
    usable = usable_anchors(grid, layout, priors=priors, P2=recorded["P2"])
    rows = recorded["annotations"][1]
    rows = rows[rows[:, 4] >= 0]
    boxes = np.concatenate([rows[:, :4], rows[:, 5:12]], axis=1).astype(np.float32)
    truth = GroundTruth(boxes, rows[:, 4].astype(np.int64), NONE, NONE)
    index = np.flatnonzero(usable)
    match, background = match_anchors(grid.boxes[index], boxes[:, :4], claim_without_overlap=True)
    assert (match >= 0).sum() == expected["pos"] and background.sum() == expected["neg"]
    first = len(recorded["img1_with_outside_gt_pos_anchor"])
    np.testing.assert_array_equal(index[:first], recorded["img1_with_outside_gt_pos_anchor"])
    targets = assign(truth, grid, usable, priors=priors, claim_without_overlap=True)
    assert len(targets.positive) == expected["pos_valid"]
    without = assign(truth, grid, usable, priors=priors)
    assert len(without.positive) < expected["pos_valid"] / 100


def test_ignored_anchors_teach_nothing(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "loss_elementary.npz")
    assert not recorded["focal_t-1_value"].any() and not recorded["focal_t-1_grad"].any()
    logits = torch.tensor(recorded["focal_x"])[:, None].repeat(1, 2)
    assert focal_terms(logits, torch.zeros_like(logits), torch.tensor([20.0, 40.0])).any()  # as background they would


@pytest.mark.parametrize("case", range(4))
def test_drawn_numbers(facts: dict[str, Any], case: int) -> None:
    recorded = facts["photometric"][case]
    change = draw_colour_change(np.random.RandomState(recorded["numpy_legacy_seed"]))
    values = [draw[-1] for draw in recorded["draws"] if draw[0] == "uniform"]
    contrast = change.contrast
    ours = [change.brightness, change.saturation, change.hue_degrees]
    ours.insert(1 if change.contrast_first else 3, contrast)
    assert change.contrast_first == (recorded["draws"][0][1] <= 0.5)
    np.testing.assert_array_equal(ours, values)


@pytest.mark.parametrize(("height", "width"), [(375, 1242), (370, 1224), (376, 1241)])
def test_prepared_pixels(
    recorded: Any, facts: dict[str, Any], golden_module: Callable[[str], ModuleType], height: int, width: int
) -> None:
    manifest = preset("paper").manifest(input_type="float32")
    cameras = golden_module("official/recorded_inputs.py")
    view = network_view(StereoGeometry(cameras.P2_CAMERA, cameras.P3_CAMERA, (width, height)), manifest)
    pair = golden_module("network/recorded_case.py").image_pair(height, width, PREPARED_SEED)
    key = f"{height}x{width}"
    assert f"{zlib.crc32(pair[0].tobytes()):08x}" == facts[f"preprocess_{key}"]["left_u8_crc32"]
    for side, image in zip(("left", "right"), pair, strict=True):
        small = to_network_image(np.ascontiguousarray(image[..., ::-1]), view, as_float=True)
        ours = normalise(to_planes(small), manifest.normalisation)[0].transpose(1, 2, 0)
        expected = facts[f"preprocess_{key}"][side]
        flat = ours.astype(np.float64).ravel()
        assert flat.mean() == pytest.approx(expected["mean"], abs=PIXEL_TOLERANCE)
        assert flat.std() == pytest.approx(expected["std"], abs=PIXEL_TOLERANCE)
        assert flat.max() == pytest.approx(expected["max"], abs=PIXEL_TOLERANCE)
        checksum = float(flat @ np.cos(0.37 * np.arange(flat.size)))
        assert checksum == pytest.approx(expected["cos_checksum"], abs=CHECKSUM_TOLERANCE)
        if side == "left":
            np.testing.assert_allclose(ours[:, -8:][SLICE_ROWS], recorded[f"pre_{key}_left_last_cols"], atol=1e-5)
