"""Frames, geometry and box records: shapes, refusals, the recorded corners."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from runtime.contracts.errors import FormatError, FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry, back_project, project_to_image
from runtime.contracts.objects import Detections3D, Objects3D, box_corners, ground_corners, wrap_angle_rad

P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])
CORNER_TOLERANCE_M = 1e-9


def detections(scores: list[float], classes: list[int] | None = None) -> Detections3D:
    count = len(scores)
    return Detections3D(
        class_id=np.array(classes or [0] * count),
        score=np.array(scores),
        box_in_left_image=np.arange(4 * count, dtype=float).reshape(count, 4),
        center_in_camera=np.ones((count, 3)),
        size_hwl=np.ones((count, 3)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=("Car", "Pedestrian"),
    )


def test_empty_records() -> None:
    assert len(Detections3D.empty(("Car",))) == 0
    assert len(Objects3D.empty(("Car",))) == 0
    assert len(Detections3D.empty(("Car",)).above(0.5)) == 0


def test_detections_are_sorted_and_read_only() -> None:
    found = detections([0.2, 0.9, 0.5])
    np.testing.assert_array_equal(found.score, [0.9, 0.5, 0.2])
    np.testing.assert_array_equal(found.box_in_left_image[:, 0], [4, 8, 0])
    with pytest.raises(ValueError, match="read-only"):
        found.score[0] = 1.0
    assert len(found.above(0.5)) == 2


def test_arrays_given_are_not_aliased() -> None:
    scores = np.array([0.5])
    record = Detections3D(
        np.array([0]), scores, np.zeros((1, 4)), np.ones((1, 3)), np.ones((1, 3)), np.zeros(1), np.zeros(1), ("Car",)
    )
    scores[0] = 0.1
    assert record.score[0] == 0.5


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"score": np.array([np.nan])}, "not finite"),
        ({"class_id": np.array([2])}, "class ids"),
        ({"center_in_camera": np.zeros((1, 2))}, "center_in_camera has shape"),
        ({"yaw_rad": np.zeros(2)}, "yaw_rad has shape"),
    ],
)
def test_what_does_not_fit_is_refused(change: dict[str, np.ndarray], message: str) -> None:
    good = detections([0.5])
    values = {name: getattr(good, name) for name in good.__dataclass_fields__}
    with pytest.raises(FormatError, match=message):
        Detections3D(**{**values, **change})


@given(st.floats(-100, 100))
def test_wrapped_angles_keep_their_direction(angle: float) -> None:
    wrapped = float(wrap_angle_rad(np.array(angle)))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-9)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-9)


@given(st.floats(-30, 30), st.floats(-3, 3), st.floats(1, 90))
def test_projection_and_back(x: float, y: float, z: float) -> None:
    points = np.array([[x, y, z]])
    for matrix in (P2, P3):
        pixels, depth = project_to_image(matrix, points)
        np.testing.assert_allclose(back_project(matrix, pixels, depth), points, atol=1e-6)


def test_geometry_facts() -> None:
    geometry = StereoGeometry(P2, P3, (1242, 375))
    assert geometry.baseline_m == pytest.approx(0.53272, abs=1e-5)
    half = geometry.scale((0.5, 0.5), (621, 188))
    assert half.focal_px == pytest.approx(geometry.focal_px / 2)
    assert half.baseline_m == pytest.approx(geometry.baseline_m)
    cut = geometry.crop(left=10, top=100, size_wh=(1232, 275))
    assert cut.principal_point_px == pytest.approx((599.5593, 72.854))
    with pytest.raises(FormatError, match="3x4"):
        StereoGeometry(np.eye(3), P3, (10, 10))
    with pytest.raises(FormatError, match="positive focal"):
        StereoGeometry(-P2, P3, (10, 10))


def test_frames_refuse_what_is_no_pair() -> None:
    geometry = StereoGeometry(P2, P3, (4, 2))
    image = np.zeros((2, 4, 3), np.uint8)
    frame = StereoFrame(image, image, 0.0, 0, "a", geometry)
    assert frame.size_wh == (4, 2)
    with pytest.raises(ValueError, match="read-only"):
        frame.left[0, 0, 0] = 1
    with pytest.raises(FrameError, match="equal sizes"):
        StereoFrame(image, np.zeros((2, 5, 3), np.uint8), 0.0, 0, "a", geometry)
    with pytest.raises(FrameError, match="geometry is for"):
        StereoFrame(np.zeros((2, 5, 3), np.uint8), None, 0.0, 0, "a", geometry)
    with pytest.raises(FrameError, match="expected uint8"):
        StereoFrame(image.astype(np.float32), None, 0.0, 0, "a", geometry)  # type: ignore[arg-type]


def test_recorded_corners(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "data_pipeline.npz")
    state = recorded["proj_xyz_state"]
    ours = box_corners(state[:, :3], state[:, [4, 3, 5]], recorded["proj_theta"])
    np.testing.assert_allclose(ours, recorded["proj_corners"], atol=CORNER_TOLERANCE_M)


def test_no_box_has_no_ground_corners() -> None:
    assert ground_corners(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)).shape == (0, 4, 2)


@given(st.floats(-30, 30), st.floats(1, 90), st.floats(-7, 7))
def test_ground_corners_are_those_of_the_box_in_order(x: float, z: float, yaw: float) -> None:
    center, size_hwl, yaw_rad = np.array([[x, 1.0, z]]), np.array([[1.5, 1.8, 4.2]]), np.array([yaw])
    found = ground_corners(center[:, [0, 2]], size_hwl[:, [2, 1]], yaw_rad)
    corners = box_corners(center, size_hwl, yaw_rad)[:, :, [0, 2]]
    np.testing.assert_allclose(found, corners[:, [4, 5, 0, 1]], atol=CORNER_TOLERANCE_M)
