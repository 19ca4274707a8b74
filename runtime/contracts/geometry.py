"""The camera side: projection matrices of a rectified stereo pair for a stated image size."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FormatError

FloatArray = NDArray[np.float64]
MIN_DEPTH_M = 1e-6


@dataclass(frozen=True, slots=True)
class StereoGeometry:
    """Projection of the rectified reference camera's frame (x right, y down, z forward, metres) to both images.

    Attributes:
        P2: (3, 4) float64, reference camera to left pixels.
        P3: (3, 4) float64, reference camera to right pixels.
        image_size_wh: width and height in pixels of the images that P2 and P3 are for.

    Raises:
        FormatError: a matrix has another shape, is not finite, or has no positive focal length.
    """

    P2: FloatArray
    P3: FloatArray
    image_size_wh: tuple[int, int]

    def __post_init__(self) -> None:
        for name in ("P2", "P3"):
            matrix = np.array(getattr(self, name), dtype=np.float64)
            if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or matrix[0, 0] <= 0 or matrix[1, 1] <= 0:
                raise FormatError(
                    f"{name} is {matrix.tolist()}, expected a finite 3x4 projection with positive focal lengths; "
                    "check the calibration file"
                )
            matrix.setflags(write=False)
            object.__setattr__(self, name, matrix)

    @property
    def focal_px(self) -> float:
        """Horizontal focal length of the left image in pixels."""
        return float(self.P2[0, 0])

    @property
    def principal_point_px(self) -> tuple[float, float]:
        """(column, row) of the left principal point in pixels."""
        return float(self.P2[0, 2]), float(self.P2[1, 2])

    @property
    def baseline_m(self) -> float:
        """Distance of the two camera centres along x in metres; positive when the right camera is right of the left."""
        return float(self.P2[0, 3] / self.P2[0, 0] - self.P3[0, 3] / self.P3[0, 0])

    @property
    def to_left_camera_m(self) -> FloatArray:
        """(3,) metres: what brings a point of the reference camera's frame into the left camera's."""
        return np.array([self.P2[0, 3] / self.P2[0, 0], self.P2[1, 3] / self.P2[1, 1], 0.0])

    def crop(self, *, left: float, top: float, size_wh: tuple[int, int]) -> StereoGeometry:
        """The geometry after cutting ``left`` columns and ``top`` rows (negative: padding)."""
        shift = np.array([[1.0, 0.0, -left], [0.0, 1.0, -top], [0.0, 0.0, 1.0]])
        return StereoGeometry(shift @ self.P2, shift @ self.P3, size_wh)

    def scale(self, factor_xy: tuple[float, float], size_wh: tuple[int, int]) -> StereoGeometry:
        """The geometry after resizing columns and rows by ``factor_xy``."""
        stretch = np.diag([factor_xy[0], factor_xy[1], 1.0])
        return StereoGeometry(stretch @ self.P2, stretch @ self.P3, size_wh)


def project_to_image(projection: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Project points of the reference camera frame.

    Args:
        projection: (3, 4), P2 or P3.
        points: (..., 3) metres.

    Returns:
        Pixels (..., 2) and depth (...,) in metres (third homogeneous coordinate, z + t_z).
    """
    homogeneous = points @ projection[:, :3].T + projection[:, 3]
    depth_m = homogeneous[..., 2]
    safe = np.where(np.abs(depth_m) < MIN_DEPTH_M, MIN_DEPTH_M, depth_m)
    return homogeneous[..., :2] / safe[..., None], depth_m


def back_project(projection: FloatArray, pixels: FloatArray, depth_m: FloatArray) -> FloatArray:
    """Invert `project_to_image`: pixels (N, 2) and third homogeneous coordinate (N,) to points (N, 3) in metres."""
    rhs = np.concatenate([pixels * depth_m[:, None], depth_m[:, None]], axis=1) - projection[:, 3]
    points: FloatArray = np.linalg.solve(projection[:, :3], rhs.T).T.astype(np.float64, copy=False)
    return points
