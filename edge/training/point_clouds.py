"""Lidar points of a KITTI object folder in the labels' camera, for disparity supervision from points (ablation).

``ROOT/training/velodyne/ID.bin``: float32 x y z reflectance in the scanner's frame; ``calib/ID.txt`` turns it into the
rectified reference camera's: ``R0_rect (Tr_velo_to_cam x)``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from runtime.contracts.errors import FormatError, SourceError
from runtime.contracts.geometry import FloatArray
from runtime.sources.base import FrameSequence
from runtime.sources.uri import parse_uri

COLUMNS = 4
ROTATION, TRANSFORM = "R0_rect", "Tr_velo_to_cam"


def points_in_camera(source: FrameSequence, index: int) -> FloatArray:
    """(N, 3) float64 metres: what the lidar saw of a frame.

    Raises:
        SourceError: the source is no KITTI object folder, or a file of the frame is missing.
        FormatError: a file is malformed.
    """
    uri = parse_uri(source.uri)
    if uri.scheme != "kitti-object":
        raise SourceError(
            f"{source.uri} has no points, expected kitti-object:ROOT with training/velodyne; "
            "choose block matching or another dataset"
        )
    folder = Path(uri.target) / "training"
    stem = source.frame_id(index)
    cloud, calibration = folder / "velodyne" / f"{stem}.bin", folder / "calib" / f"{stem}.txt"
    for file in (cloud, calibration):
        if not file.is_file():
            raise SourceError(f"{file} is missing, expected a frame with points; add KITTI's velodyne files")
    values = np.frombuffer(cloud.read_bytes(), dtype=np.uint8)
    if values.size % (4 * COLUMNS):
        raise FormatError(f"{cloud} has {values.size} bytes, expected 16 a point; copy it again")
    in_scanner = values.view(np.float32).reshape(-1, COLUMNS)[:, :3].astype(np.float64)
    rotation, transform = _camera_of_scanner(calibration)
    points: FloatArray = (in_scanner @ transform[:, :3].T + transform[:, 3]) @ rotation.T
    return points


def _camera_of_scanner(file: Path) -> tuple[FloatArray, FloatArray]:
    rows = {}
    for line in file.read_text(encoding="utf-8").splitlines():
        name, _, numbers = line.partition(":")
        rows[name.strip()] = numbers.split()
    found = []
    for name, shape in ((ROTATION, (3, 3)), (TRANSFORM, (3, 4))):
        try:
            found.append(np.array([float(word) for word in rows[name]]).reshape(shape))
        except (KeyError, ValueError):
            raise FormatError(
                f"{file} has no {name} of {shape[0] * shape[1]} numbers, expected KITTI's object calibration; "
                "copy it again"
            ) from None
    return found[0], found[1]
