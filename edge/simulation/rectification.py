"""What calibration leaves over: the views of a real pair do not lie on exactly the same rows.

The left view stays where the labels say. The right one is shifted, turned and stretched by so little that no point of
it leaves its row by more than about a pixel; along the rows it moves far less, since that would change every depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

WORST_ROWS_PX = 1.0
_TYPICAL_ROWS_PX, _TYPICAL_COLUMNS_PX, _WORST_COLUMNS_PX = 0.3, 0.05, 0.15
_TYPICAL_ROLL_RAD, _TYPICAL_STRETCH = 2.0e-4, 1.5e-4
_UNNOTICED_PX = 0.02


@dataclass(frozen=True, slots=True)
class RectificationError:
    """How the right view lies beside where it should.

    Attributes:
        rows_px, columns_px: shift of the picture's middle, down and to the right.
        roll_rad: turn about the middle.
        stretch: of the rows' distance from the middle row, less 1.
    """

    rows_px: float = 0.0
    columns_px: float = 0.0
    roll_rad: float = 0.0
    stretch: float = 0.0

    @staticmethod
    def draw(rng: np.random.Generator) -> RectificationError:
        """The error of one drive's calibration."""
        return RectificationError(
            float(np.clip(rng.normal(0.0, _TYPICAL_ROWS_PX), -0.8 * WORST_ROWS_PX, 0.8 * WORST_ROWS_PX)),
            float(np.clip(rng.normal(0.0, _TYPICAL_COLUMNS_PX), -_WORST_COLUMNS_PX, _WORST_COLUMNS_PX)),
            float(rng.normal(0.0, _TYPICAL_ROLL_RAD)),
            float(rng.normal(0.0, _TYPICAL_STRETCH)),
        )

    def moved(self, points: NDArray[np.float64], size_wh: tuple[int, int]) -> NDArray[np.float64]:
        """Where pixels (..., 2) of an exact view come to lie."""
        return points @ self._matrix(size_wh)[:, :2].T + self._matrix(size_wh)[:, 2]

    def _matrix(self, size_wh: tuple[int, int]) -> NDArray[np.float64]:
        middle = 0.5 * (np.array(size_wh, dtype=np.float64) - 1.0)
        cos, sin = np.cos(self.roll_rad), np.sin(self.roll_rad)
        linear = np.array([[cos, -sin], [sin, cos]]) @ np.diag([1.0, 1.0 + self.stretch])
        shift = np.array([self.columns_px, self.rows_px])
        return np.concatenate([linear, (middle - linear @ middle + shift)[:, None]], axis=1)

    def apply(self, radiance: NDArray[np.float32]) -> NDArray[np.float32]:
        """The right view (H, W, 3) as the imperfect calibration gives it; edges repeat."""
        if abs(self.rows_px) + abs(self.columns_px) < _UNNOTICED_PX and self.roll_rad == 0.0 and self.stretch == 0.0:
            return radiance
        height, width = radiance.shape[:2]
        matrix = self._matrix((width, height))
        # linear light is sampled bilinearly: a cubic would ring round the sun's glints
        return cv2.warpAffine(
            radiance, matrix, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
