"""A depthai calibration JSON to the geometry of its rectified pair, without depthai.

What is assumed, as depthai's stereo node does it with its defaults: both rectified images have the intrinsics of the
right camera; the baseline is the calibrated translation between the two (not the one from the drawing), in
centimetres; the rectified left camera is the reference frame. A stream of a wider shape than the calibration's image
is scaled to its width and cut evenly above and below; a taller shape is refused, since depthai's calibration and its
cameras disagree on what that means.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import FloatArray, StereoGeometry

METRES_OF_UNIT = {0: 1.0, 1: 0.01, 2: 0.001, 3: 0.0254, 4: 0.3048}
"""depthai's LengthUnit: metre, centimetre, millimetre, inch, foot."""
CENTIMETRE = 1
_MOST_CAMERAS = 32


def parse_depthai_calibration(
    data: dict[str, Any], image_size_wh: tuple[int, int] | None, *, where: str = "calibration"
) -> StereoGeometry:
    """P2 and P3 of the rectified pair.

    Args:
        data: what ``CalibrationHandler.eepromToJsonFile`` writes.
        image_size_wh: of the rectified stream; None takes the calibration's own size.
        where: for messages.

    Raises:
        FormatError: the stereo pair, its intrinsics or its extrinsics are missing or malformed.
    """
    try:
        cameras = {int(socket): camera for socket, camera in data["cameraData"]}
        pair = data["stereoRectificationData"]
        left, right = int(pair["leftCameraSocket"]), int(pair["rightCameraSocket"])
        if left not in cameras or right not in cameras:
            raise FormatError(
                f"{where} names stereo sockets {left} and {right}, found cameras {sorted(cameras)}, "
                "expected both; calibrate the stereo pair"
            )
        intrinsics = np.array(cameras[right]["intrinsicMatrix"], dtype=np.float64).reshape(3, 3)
        own_size = (int(cameras[right]["width"]), int(cameras[right]["height"]))
        baseline_m = float(np.linalg.norm(_position(cameras, left) - _position(cameras, right)))
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(
            f"{where} lacks or garbles {error}, expected a depthai calibration with cameraData and "
            "stereoRectificationData; save it again with eepromToJsonFile"
        ) from None
    if own_size[0] <= 0 or own_size[1] <= 0 or baseline_m == 0.0:
        raise FormatError(
            f"{where} has image size {own_size} and baseline {baseline_m} m, expected a calibrated pair; calibrate it"
        )
    size_wh = image_size_wh or own_size
    return rectified_geometry(fit_intrinsics(intrinsics, own_size, size_wh), baseline_m, size_wh)


def rectified_geometry(intrinsics: FloatArray, baseline_m: float, image_size_wh: tuple[int, int]) -> StereoGeometry:
    """P2 = K [I | 0], P3 = K [I | (-baseline, 0, 0)]."""
    left = np.hstack([intrinsics, np.zeros((3, 1))])
    right = left.copy()
    right[0, 3] = -intrinsics[0, 0] * baseline_m
    return StereoGeometry(left, right, image_size_wh)


def fit_intrinsics(intrinsics: FloatArray, from_size_wh: tuple[int, int], to_size_wh: tuple[int, int]) -> FloatArray:
    """Intrinsics after scaling an image to another width and cutting rows evenly above and below.

    Raises:
        FormatError: the other size is taller in shape.
    """
    factor = to_size_wh[0] / from_size_wh[0]
    surplus_rows = from_size_wh[1] * factor - to_size_wh[1]
    if surplus_rows < -1.0:  # a rounded height may be half a row too tall
        raise FormatError(
            f"images are {to_size_wh[0]}x{to_size_wh[1]} and the calibration is for "
            f"{from_size_wh[0]}x{from_size_wh[1]}, expected that shape or a wider one; use a smaller height"
        )
    fitted = np.diag([factor, factor, 1.0]) @ intrinsics
    fitted[1, 2] -= surplus_rows / 2
    return fitted


def _position(cameras: dict[int, dict[str, Any]], socket: int) -> FloatArray:
    """Camera centre in the frame that its chain of extrinsics ends at: x' = R x + t at each link."""
    position = np.zeros(3)
    for _ in range(_MOST_CAMERAS):
        extrinsics = cameras[socket]["extrinsics"]
        socket = int(extrinsics["toCameraSocket"])
        if socket == -1:
            return position
        rotation = np.array(extrinsics["rotationMatrix"], dtype=np.float64).reshape(3, 3)
        shift = np.array([float(extrinsics["translation"][axis]) for axis in "xyz"])
        position = rotation @ position + shift * METRES_OF_UNIT[int(extrinsics.get("lengthUnit", CENTIMETRE))]
    raise ValueError("a chain of extrinsics without end")
