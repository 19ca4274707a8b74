"""Camera rigs: KITTI's, an OAK-D-like one, or one from a file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.simulation.scene import PinholeCamera
from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import StereoGeometry
from runtime.rig import load_geometry

FloatArray = NDArray[np.float64]
_KITTI_FOCAL_PX, _KITTI_CENTRE_PX, _KITTI_SIZE_WH = 721.5377, (609.5593, 172.854), (1242, 375)
_KITTI_P2_SHIFT, _KITTI_P3_SHIFT = 44.85728, -339.5242
_OAK_FOCAL_PX, _OAK_SIZE_WH, _OAK_BASELINE_M = 800.0, (1280, 400), 0.075


def _projection(focal_px: float, centre_px: tuple[float, float], shift: float) -> FloatArray:
    return np.array([[focal_px, 0.0, centre_px[0], shift], [0.0, focal_px, centre_px[1], 0.0], [0.0, 0.0, 1.0, 0.0]])


def kitti_rig() -> StereoGeometry:
    """KITTI's colour cameras of 2011-09-26; labels live in the reference camera 6 cm right of the left one."""
    return StereoGeometry(
        _projection(_KITTI_FOCAL_PX, _KITTI_CENTRE_PX, _KITTI_P2_SHIFT),
        _projection(_KITTI_FOCAL_PX, _KITTI_CENTRE_PX, _KITTI_P3_SHIFT),
        _KITTI_SIZE_WH,
    )


def oak_d_rig() -> StereoGeometry:
    """An OAK-D-like pair, cut to 1280 x 400; labels live in the left camera."""
    centre = (0.5 * _OAK_SIZE_WH[0], 0.5 * _OAK_SIZE_WH[1])
    return StereoGeometry(
        _projection(_OAK_FOCAL_PX, centre, 0.0),
        _projection(_OAK_FOCAL_PX, centre, -_OAK_FOCAL_PX * _OAK_BASELINE_M),
        _OAK_SIZE_WH,
    )


def load_rig(name: str) -> StereoGeometry:
    """``kitti``, ``oak-d``, or the path of a geometry file: our JSON, depthai's, or KITTI text that names a size.

    Raises:
        FormatError: no such rig or file, or the file does not hold what a rig needs.
    """
    if name == "kitti":
        return kitti_rig()
    if name == "oak-d":
        return oak_d_rig()
    path = Path(name)
    if not path.is_file():
        raise FormatError(f"rig {name!r} is no file, expected kitti, oak-d or a geometry file; check the spelling")
    geometry = load_geometry(path)
    for matrix, label in ((geometry.P2, "P2"), (geometry.P3, "P3")):
        if not np.allclose(matrix[2, :3], (0.0, 0.0, 1.0)) or abs(matrix[1, 0]) > 1e-9 or abs(matrix[0, 1]) > 1e-9:
            raise FormatError(f"{path}: {label} is not the projection of a rectified camera; rectify the pair first")
    if geometry.baseline_m <= 0.0:
        raise FormatError(
            f"{path} has a baseline of {geometry.baseline_m:.4f} m, expected a positive one; swap P2 and P3"
        )
    return geometry


def cameras(geometry: StereoGeometry, camera_from_world: FloatArray) -> tuple[PinholeCamera, PinholeCamera]:
    """Left and right pinhole cameras; ``camera_from_world`` (4, 4) leads to the labels' reference frame."""
    pair = []
    for matrix in (geometry.P2, geometry.P3):
        intrinsics = np.array(matrix[:, :3])
        shift = np.eye(4)
        shift[:3, 3] = np.linalg.solve(intrinsics, matrix[:, 3])
        pair.append(PinholeCamera(intrinsics, shift @ camera_from_world, geometry.image_size_wh))
    return pair[0], pair[1]
