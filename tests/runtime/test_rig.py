"""Geometry files and the check of a camera against a model's rig."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.errors import FormatError, RigError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_calib
from runtime.contracts.manifest import RigLimits
from runtime.rig import check_rig, format_geometry, load_geometry


def geometry(
    *, focal_px: float = 700.0, baseline_m: float = 0.54, size: tuple[int, int] = (1242, 375)
) -> StereoGeometry:
    left = np.array([[focal_px, 0, 600.0, 45.0], [0, focal_px, 170.0, 0.2], [0, 0, 1, 0.003]])
    right = left.copy()
    right[0, 3] -= focal_px * baseline_m
    return StereoGeometry(left, right, size)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="cannot be read"):
        load_geometry(tmp_path / "none.txt", (10, 10))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no P2 and no P3"),
        (b"P2: 1 2 3\n", "expected 12"),
        (b"P2: " + b"a " * 12, "12 numbers"),
        (b"\xff\xfe\x00", "no text"),
        (b"{", "no JSON"),
        (b"{}", "the keys none"),
        (b'{"schema": 1, "image_size_wh": [1, 1], "P2": [], "P3": [], "more": 1}', "more"),
        (b'{"schema": 2, "image_size_wh": [1, 1], "P2": [], "P3": []}', "schema 2"),
        (b'{"schema": true, "image_size_wh": [1, 1], "P2": [], "P3": []}', "schema True"),
        (b'{"schema": 1, "image_size_wh": [1, 0], "P2": [], "P3": []}', "image_size_wh"),
        (b'{"schema": 1, "image_size_wh": "big", "P2": [], "P3": []}', "image_size_wh"),
        (b'{"schema": 1, "image_size_wh": [10, 10], "P2": [], "P3": []}', "3x4"),
        (b'{"schema": 1, "image_size_wh": [10, 10], "P2": [["a"]], "P3": []}', "no table of numbers"),
        (b'{"cameraData": [], "stereoRectificationData": {}}', "leftCameraSocket"),
    ],
)
def test_a_file_that_is_none(content: bytes, words: str, tmp_path: Path) -> None:
    path = tmp_path / "rig"
    path.write_bytes(content)
    with pytest.raises(FormatError, match=words) as caught:
        load_geometry(path, (10, 10))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


def test_json_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(format_geometry(geometry()), encoding="utf-8")
    again = load_geometry(path)
    assert np.array_equal(again.P2, geometry().P2)
    assert np.array_equal(again.P3, geometry().P3)
    assert again.image_size_wh == (1242, 375)


@pytest.mark.parametrize("size_wh", [(621, 188), (621, 187), (2484, 750)])
def test_json_for_resized_images(size_wh: tuple[int, int], tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(format_geometry(geometry()), encoding="utf-8")
    resized = load_geometry(path, size_wh)
    assert resized.image_size_wh == size_wh
    assert resized.focal_px == pytest.approx(700.0 * size_wh[0] / 1242)
    assert resized.baseline_m == pytest.approx(0.54)


@pytest.mark.parametrize("size_wh", [(1242, 370), (1224, 375), (100, 100)])
def test_json_for_cut_images(size_wh: tuple[int, int], tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(format_geometry(geometry()), encoding="utf-8")
    with pytest.raises(FormatError, match="1242x375"):
        load_geometry(path, size_wh)


def test_kitti_text_is_for_the_images_that_it_lies_beside(tmp_path: Path) -> None:
    path = tmp_path / "calib.txt"
    path.write_text(format_calib(geometry()), encoding="utf-8")
    assert load_geometry(path, (1242, 375)).baseline_m == pytest.approx(0.54)
    with pytest.raises(FormatError, match="names no image size"):
        load_geometry(path)


def test_raw_calibration_names_its_size(tmp_path: Path) -> None:
    path = tmp_path / "calib_cam_to_cam.txt"
    text = format_calib(geometry()).replace("P2:", "P_rect_02:").replace("P3:", "P_rect_03:")
    path.write_text("S_rect_02: 1.242000e+03 3.750000e+02\n" + text, encoding="utf-8")
    assert load_geometry(path).image_size_wh == (1242, 375)
    assert load_geometry(path, (621, 188)).focal_px == pytest.approx(350.0)
    with pytest.raises(FormatError, match="1242x375"):
        load_geometry(path, (1242, 300))


RIG = RigLimits(focal_px=500.0, baseline_m=0.5)


@pytest.mark.parametrize(
    ("focal_px", "baseline_m", "stereo", "verdict"),
    [
        (500.0, 0.5, True, "fits"),
        (524.0, 0.5, True, "fits"),  # 4.8 %
        (500.0, 0.476, True, "fits"),
        (527.0, 0.5, True, "focal length"),  # 5.4 %
        (500.0, 0.4, True, "baseline"),  # 20 %
        (380.0, 0.6, True, "focal length"),  # 24 %, the worse of the two is named
        (500.0, 0.37, True, "too far"),  # 26 %
        (700.0, 0.5, True, "too far"),
        (500.0, 0.075, False, "fits"),  # one view has no baseline
        (700.0, 0.5, False, "too far"),
    ],
)
def test_rig(focal_px: float, baseline_m: float, stereo: bool, verdict: str) -> None:
    camera = geometry(focal_px=focal_px, baseline_m=baseline_m)
    if verdict == "too far":
        with pytest.raises(RigError, match="--allow-other-rig"):
            check_rig(camera, RIG, stereo=stereo, allow=False)
        assert "allowed" in (check_rig(camera, RIG, stereo=stereo, allow=True) or "")
        return
    warning = check_rig(camera, RIG, stereo=stereo, allow=False)
    assert warning is None if verdict == "fits" else verdict in (warning or "")


@pytest.mark.parametrize(
    ("row", "shift_px", "stereo", "verdict"),
    [
        (0, 0.48, True, "fits"),  # KITTI's rig
        (0, -1.5, True, "principal columns are 1.5 network px apart"),
        (1, 2.0, True, "principal rows are 2 network px apart"),
        (0, 40.0, True, "too far"),  # calibrated, not rectified
        (1, -5.0, True, "too far"),
        (0, 40.0, False, "fits"),
    ],
)
def test_views_that_look_another_way(row: int, shift_px: float, stereo: bool, verdict: str) -> None:
    camera = geometry()
    right = camera.P3.copy()
    right[row, 2] += shift_px
    camera = dataclasses.replace(camera, P3=right)
    rig = RigLimits(camera.focal_px, camera.baseline_m)
    if verdict == "too far":
        with pytest.raises(RigError, match=r"expected at most 4; use a pair that is rectified .* --allow-other-rig"):
            check_rig(camera, rig, stereo=stereo, allow=False)
        return
    warning = check_rig(camera, rig, stereo=stereo, allow=False)
    assert warning is None if verdict == "fits" else verdict in (warning or "")


def test_a_silent_difference_hides_no_other() -> None:
    camera = geometry(focal_px=527.0, baseline_m=0.5)  # 5.4 %
    right = camera.P3.copy()
    right[0, 2] -= 0.95  # silent, and nearer to what is tolerated
    camera = dataclasses.replace(camera, P3=right)
    assert "focal length" in (check_rig(camera, RIG, stereo=True, allow=False) or "")


def test_kitti_days_pass_as_one_rig(kitti_dir: Path) -> None:
    """The official calibrations differ by 2 % in focal length; none may warn for a model of another day."""
    found = {}
    for path in sorted((kitti_dir / "object" / "training" / "calib").glob("*.txt")):
        camera = load_geometry(path, (1242, 375))
        found[round(camera.focal_px)] = camera
    assert len(found) > 1
    for camera in found.values():
        assert check_rig(camera, RigLimits(721.5377, 0.5327), stereo=True, allow=False) is None


def test_json_is_plain(tmp_path: Path) -> None:
    assert set(json.loads(format_geometry(geometry()))) == {"schema", "image_size_wh", "P2", "P3"}
