"""The world from above: own car at the bottom, range rings, field of view, boxes with their heading."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Detections3D, Objects3D, ground_corners
from runtime.sinks.palette import (
    BACKGROUND,
    DIM_TEXT,
    EGO,
    FIELD_OF_VIEW,
    GRID,
    LABEL,
    PANEL,
    Colour,
    class_colour,
)
from runtime.sinks.shapes import draw_line, draw_outline, fill_polygon
from runtime.sinks.text import draw_text, text_width

RANGE_M = 64.0
RING_STEP_M = 10
EGO_ROOM_PX = 56
EGO_WIDTH_M, EGO_LENGTH_M = 1.9, 4.4
CAMERA_TO_BUMPER_M = 1.6

Image = NDArray[np.uint8]


class BirdEyeView:
    """A panel of fixed size; the ground that no frame changes is drawn once a camera."""

    def __init__(self, size_wh: tuple[int, int]) -> None:
        """Sets the scale so that `RANGE_M` ahead fit."""
        self._size_wh = size_wh
        self._pixels_per_m = (size_wh[1] - EGO_ROOM_PX - 8) / RANGE_M
        self._ground: tuple[StereoGeometry, Image] | None = None

    def draw(self, geometry: StereoGeometry, detections: Detections3D, labels: Objects3D | None) -> Image:
        """The panel of one frame, (height, width, 3) uint8 BGR."""
        if self._ground is None or self._ground[0] is not geometry:
            self._ground = (geometry, self._draw_ground(geometry))
        panel = self._ground[1].copy()
        for class_id, ground_xz in zip(detections.class_id, footprints(detections), strict=True):
            self._draw_object(panel, ground_xz, class_colour(detections.class_names[class_id]))
        if labels is not None:
            for ground_xz in footprints(labels):
                draw_outline(panel, self.to_panel(ground_xz), colour=LABEL)
        return panel

    def to_panel(self, ground_xz: FloatArray) -> FloatArray:
        """Metres (..., 2), x right and z ahead of the camera, to panel pixels."""
        column = self._size_wh[0] / 2 + ground_xz[..., 0] * self._pixels_per_m
        row = self._size_wh[1] - EGO_ROOM_PX - ground_xz[..., 1] * self._pixels_per_m
        return np.stack([column, row], axis=-1)

    def _draw_object(self, panel: Image, ground_xz: FloatArray, colour: Colour) -> None:
        corners = self.to_panel(ground_xz)
        fill_polygon(panel, corners, colour=colour, opacity=0.55)
        draw_outline(panel, corners, colour=colour, width=2)
        front, middle = 0.5 * (corners[0] + corners[1]), corners.mean(axis=0)
        draw_line(panel, middle, front + 0.35 * (front - middle), colour=colour, width=2)

    def _draw_ground(self, geometry: StereoGeometry) -> Image:
        width, height = self._size_wh
        panel = np.empty((height, width, 3), np.uint8)
        panel[:] = PANEL
        origin = self.to_panel(np.zeros(2))
        left, right = (
            (edge - geometry.principal_point_px[0]) / geometry.focal_px for edge in (0, geometry.image_size_wh[0])
        )
        reach = 2 * RANGE_M
        wedge = self.to_panel(np.array([[0.0, 0.0], [left * reach, reach], [right * reach, reach]]))
        fill_polygon(panel, wedge, colour=FIELD_OF_VIEW)
        center = (round(float(origin[0])), round(float(origin[1])))
        for ring_m in range(RING_STEP_M, int(RANGE_M) + 1, RING_STEP_M):
            radius = round(ring_m * self._pixels_per_m)
            cv2.ellipse(panel, center, (radius, radius), 0, 180, 360, GRID, 1, cv2.LINE_AA)
        for edge in (left, right):
            end = self.to_panel(np.array([edge * reach, reach]))
            draw_line(panel, origin, end, colour=GRID)
        for ring_m in range(RING_STEP_M, int(RANGE_M) + 1, RING_STEP_M):
            self._draw_ring_label(panel, ring_m)
        self._draw_ego(panel)
        return panel

    def _draw_ring_label(self, panel: Image, ring_m: int) -> None:
        text = f"{ring_m} m"
        at = self.to_panel(np.array([0.0, float(ring_m)]))
        column = self._size_wh[0] - text_width(text, size_px=13) - 10
        across = (column - self._size_wh[0] / 2) / self._pixels_per_m
        if across < ring_m:
            at = self.to_panel(np.array([across, float(np.sqrt(ring_m**2 - across**2))]))
        elif ring_m > RING_STEP_M:
            column = round(self._size_wh[0] / 2 + (ring_m - 2.5) * self._pixels_per_m)
            at = self.to_panel(np.array([0.0, 1.0]))
        else:
            return
        draw_text(panel, text, (column, at[1] - 4), colour=DIM_TEXT, size_px=13)

    def _draw_ego(self, panel: Image) -> None:
        half = EGO_WIDTH_M / 2
        front, rear = CAMERA_TO_BUMPER_M, CAMERA_TO_BUMPER_M - EGO_LENGTH_M
        body = np.array(
            [
                [-half * 0.8, front],
                [half * 0.8, front],
                [half, front - 0.5],
                [half, rear + 0.3],
                [half * 0.85, rear],
                [-half * 0.85, rear],
                [-half, rear + 0.3],
                [-half, front - 0.5],
            ]
        )
        screen = np.array([[-half * 0.7, 0.5], [half * 0.7, 0.5], [half * 0.85, -0.3], [-half * 0.85, -0.3]])
        fill_polygon(panel, self.to_panel(body), colour=EGO)
        draw_outline(panel, self.to_panel(body), colour=EGO)
        fill_polygon(panel, self.to_panel(screen), colour=BACKGROUND)


def footprints(boxes: Detections3D | Objects3D) -> FloatArray:
    """Ground corners of each box as `ground_corners` gives them, (N, 4, 2) in metres."""
    return ground_corners(boxes.center_in_camera[:, [0, 2]], boxes.size_hwl[:, [2, 1]], boxes.yaw_rad)
