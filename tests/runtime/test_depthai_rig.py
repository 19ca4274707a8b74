"""depthai calibrations, read without depthai and compared with what depthai itself makes of them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from runtime.contracts.errors import FormatError
from runtime.depthai_rig import fit_intrinsics, parse_depthai_calibration
from runtime.rig import load_geometry

INTRINSIC_TOLERANCE_PX = 1e-3
BASELINE_TOLERANCE_M = 1e-6
"""depthai keeps float32; both are far below a calibration's own error."""
RIGHT_K = [[796.1, 0.0, 641.7], [0.0, 796.3, 402.4], [0.0, 0.0, 1.0]]
LEFT_K = [[799.8, 0.0, 636.2], [0.0, 799.9, 399.1], [0.0, 0.0, 1.0]]


def camera(matrix: list[list[float]], to_socket: int, shift_cm: tuple[float, float, float]) -> dict[str, Any]:
    turn = np.array([[np.cos(0.01), 0, np.sin(0.01)], [0, 1, 0], [-np.sin(0.01), 0, np.cos(0.01)]])
    return {
        "intrinsicMatrix": matrix,
        "width": 1280,
        "height": 800,
        "extrinsics": {
            "rotationMatrix": (turn if to_socket >= 0 else np.eye(3)).tolist(),
            "translation": dict(zip("xyz", shift_cm, strict=True)),
            "toCameraSocket": to_socket,
        },
    }


def calibration() -> dict[str, Any]:
    """Left camera (socket 1) to right (2), right to colour (0), as on an OAK-D."""
    return {
        "cameraData": [
            [0, camera(RIGHT_K, -1, (0.0, 0.0, 0.0))],
            [1, camera(LEFT_K, 2, (-7.5, 0.01, 0.02))],
            [2, camera(RIGHT_K, 0, (3.7, 0.0, 0.0))],
        ],
        "stereoRectificationData": {"leftCameraSocket": 1, "rightCameraSocket": 2},
    }


def test_geometry_of_the_calibrated_size() -> None:
    geometry = parse_depthai_calibration(calibration(), None)
    assert geometry.image_size_wh == (1280, 800)
    assert geometry.P2[:, :3].tolist() == RIGHT_K
    expected_m = float(np.linalg.norm([7.5, 0.01, 0.02])) / 100
    assert geometry.baseline_m == pytest.approx(expected_m, abs=BASELINE_TOLERANCE_M)


def test_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "oak.json"
    path.write_text(json.dumps(calibration()), encoding="utf-8")
    geometry = load_geometry(path, (1280, 400))
    assert geometry.image_size_wh == (1280, 400)
    assert geometry.principal_point_px == pytest.approx((641.7, 202.4))


@pytest.mark.parametrize(
    ("size_wh", "focal_px", "center"),
    [
        ((640, 400), 398.05, (320.85, 201.2)),
        ((1280, 400), 796.1, (641.7, 202.4)),  # 200 rows cut above and below
        ((640, 360), 398.05, (320.85, 181.2)),
    ],
)
def test_scaling_keeps_the_width_and_cuts_rows_evenly(
    size_wh: tuple[int, int], focal_px: float, center: tuple[float, float]
) -> None:
    fitted = fit_intrinsics(np.array(RIGHT_K), (1280, 800), size_wh)
    assert fitted[0, 0] == pytest.approx(focal_px)
    assert (fitted[0, 2], fitted[1, 2]) == pytest.approx(center)


@pytest.mark.parametrize("size_wh", [(640, 480), (400, 400)])
def test_a_taller_shape_is_refused(size_wh: tuple[int, int]) -> None:
    with pytest.raises(FormatError, match="1280x800"):
        parse_depthai_calibration(calibration(), size_wh)


@pytest.mark.parametrize("unit", [None, 1, 2, 0])
def test_units_of_length(unit: int | None) -> None:
    data = calibration()
    per_cm = {None: 1.0, 1: 1.0, 2: 10.0, 0: 0.01}[unit]
    for _, one in data["cameraData"]:
        one["extrinsics"]["translation"] = {
            axis: value * per_cm for axis, value in one["extrinsics"]["translation"].items()
        }
        if unit is not None:
            one["extrinsics"]["lengthUnit"] = unit
    assert parse_depthai_calibration(data, None).baseline_m == pytest.approx(0.075, abs=1e-5)


def garble(data: dict[str, Any], what: str) -> None:
    first = data["cameraData"][1][1]
    if what == "no stereo":
        del data["stereoRectificationData"]
    elif what == "socket":
        data["stereoRectificationData"]["leftCameraSocket"] = 7
    elif what == "matrix":
        data["cameraData"][2][1]["intrinsicMatrix"] = [[1.0]]
    elif what == "zero baseline":
        first["extrinsics"]["translation"] = {"x": 0.0, "y": 0.0, "z": 0.0}
    elif what == "circle":
        data["cameraData"][0][1]["extrinsics"]["toCameraSocket"] = 1
    elif what == "unit":
        first["extrinsics"]["lengthUnit"] = 99
    elif what == "list":
        data["cameraData"] = 3


@pytest.mark.parametrize("what", ["no stereo", "socket", "matrix", "zero baseline", "circle", "unit", "list"])
def test_garbled(what: str) -> None:
    data = calibration()
    garble(data, what)
    with pytest.raises(FormatError) as caught:
        parse_depthai_calibration(data, (640, 400), where="oak.json")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("size_wh", [(1280, 800), (640, 400), (1280, 400), (640, 360)])
def test_as_depthai_reads_it(size_wh: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DEPTHAI_LEVEL", "off")
    depthai = pytest.importorskip("depthai")
    sockets = depthai.CameraBoardSocket
    handler = depthai.CalibrationHandler()
    for socket, matrix in ((sockets.CAM_B, LEFT_K), (sockets.CAM_C, RIGHT_K)):
        handler.setCameraIntrinsics(socket, matrix, 1280, 800)
    turn = np.eye(3).tolist()
    handler.setCameraExtrinsics(sockets.CAM_B, sockets.CAM_C, turn, [-7.5, 0.01, 0.02], [-7.5, 0.0, 0.0])
    handler.setStereoLeft(sockets.CAM_B, turn)
    handler.setStereoRight(sockets.CAM_C, turn)
    geometry = parse_depthai_calibration(handler.eepromToJson(), size_wh)
    expected = np.array(handler.getCameraIntrinsics(sockets.CAM_C, *size_wh))
    np.testing.assert_allclose(geometry.P2[:, :3], expected, atol=INTRINSIC_TOLERANCE_PX)
    baseline_cm = handler.getBaselineDistance(sockets.CAM_C, sockets.CAM_B, useSpecTranslation=False)
    assert geometry.baseline_m == pytest.approx(baseline_cm / 100, abs=BASELINE_TOLERANCE_M)
