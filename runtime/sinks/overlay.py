"""One picture a frame: the camera image with its 3D boxes, the world from above, and a strip of facts."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.sinks.base import FrameResult
from runtime.sinks.bird_eye import BirdEyeView
from runtime.sinks.boxes_in_image import draw_boxes, draw_label_boxes, fit_to_width
from runtime.sinks.palette import BACKGROUND
from runtime.sinks.strip import StatusStrip

CAMERA_WIDTH_PX, CAMERA_HEIGHT_PX = 1440, 720
"""The camera image fills one of these."""
STRIP_HEIGHT_PX = 188
BIRD_EYE_WIDTH_PX = 480
GAP_PX = 8


class OverlayRenderer:
    """Draws results of one stream; all pictures have the size that the first frame asks for."""

    def __init__(self, title: str, class_names: tuple[str, ...]) -> None:
        """Takes the model's name and classes for the strip."""
        self._strip = StatusStrip(title, class_names)
        self._camera_wh: tuple[int, int] | None = None
        self._bird_eye: BirdEyeView | None = None

    def draw(self, result: FrameResult) -> NDArray[np.uint8]:
        """The picture, (height, width, 3) uint8 BGR, both sides even for video."""
        if self._camera_wh is None or self._bird_eye is None:
            self._camera_wh = camera_size(result.frame.size_wh)
            self._bird_eye = BirdEyeView((BIRD_EYE_WIDTH_PX, self._camera_wh[1] + GAP_PX + STRIP_HEIGHT_PX))
        width, height = self._camera_wh
        camera = fit_to_width(result.frame.left, self._camera_wh)
        factor_xy = (width / result.frame.size_wh[0], height / result.frame.size_wh[1])
        projection = result.frame.geometry.scale(factor_xy, self._camera_wh).P2
        if result.labels is not None:
            draw_label_boxes(camera, projection, result.labels)
        draw_boxes(camera, projection, result.detections)

        whole = np.empty((height + GAP_PX + STRIP_HEIGHT_PX, width + GAP_PX + BIRD_EYE_WIDTH_PX, 3), np.uint8)
        whole[:] = BACKGROUND
        whole[:height, :width] = camera
        whole[height + GAP_PX :, :width] = self._strip.draw(result, (width, STRIP_HEIGHT_PX))
        whole[:, width + GAP_PX :] = self._bird_eye.draw(result.frame.geometry, result.detections, result.labels)
        return whole


def camera_size(size_wh: tuple[int, int]) -> tuple[int, int]:
    """Size in which a camera image is shown: as large as fits, both sides even."""
    factor = min(CAMERA_WIDTH_PX / size_wh[0], CAMERA_HEIGHT_PX / size_wh[1])
    width, height = (2 * round(side * factor / 2) for side in size_wh)
    return width, height
