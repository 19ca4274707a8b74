"""Pictures of what a second model sees differently: the reference above, the other below, both from above at the side.

Colours tell the state of a box, not its class: found by both in the same place (grey), by both but moved
(yellow), only by the reference (red), only by the other (blue).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.evaluation.agreement import pair_up
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray, project_to_image
from runtime.contracts.objects import Detections3D, box_corners
from runtime.sinks.bird_eye import BirdEyeView, footprints
from runtime.sinks.boxes_in_image import EDGES, NEAR_M
from runtime.sinks.palette import BACKGROUND, TEXT, Colour
from runtime.sinks.shapes import draw_line, draw_outline
from runtime.sinks.text import draw_text

MOVED_M = 0.5
CAMERA_WIDTH_PX = 1100
BIRD_EYE_WIDTH_PX = 420
CAPTION_PX = 34
TEXT_PX = 18
AGREED: Colour = (190, 190, 190)
MOVED: Colour = (40, 210, 250)
LOST: Colour = (70, 70, 240)
NEW: Colour = (250, 160, 50)
LEGEND = (("both", AGREED), (f"moved over {MOVED_M} m", MOVED), ("only reference", LOST), ("only other", NEW))

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Differences:
    """How two models' boxes of one frame differ, at their display thresholds.

    Attributes:
        reference, other: the boxes.
        reference_colours, other_colours: the state of each as a colour.
        lost, new, moved: counts.
    """

    reference: Detections3D
    other: Detections3D
    reference_colours: tuple[Colour, ...]
    other_colours: tuple[Colour, ...]
    lost: int
    new: int
    moved: int

    @property
    def count(self) -> int:
        """Boxes that differ."""
        return self.lost + self.new + self.moved


def compare_frame(reference: Detections3D, other: Detections3D) -> Differences:
    """Pair the boxes of one frame and name the state of each."""
    pairs = pair_up(reference, other)
    shift_m = np.linalg.norm(reference.center_in_camera[pairs.first] - other.center_in_camera[pairs.second], axis=1)
    left: list[Colour] = [LOST] * len(reference)
    right: list[Colour] = [NEW] * len(other)
    for first, second, shift in zip(pairs.first, pairs.second, shift_m, strict=True):
        left[first] = right[second] = MOVED if shift > MOVED_M else AGREED
    return Differences(
        reference,
        other,
        tuple(left),
        tuple(right),
        lost=len(pairs.only_first),
        new=len(pairs.only_second),
        moved=int((shift_m > MOVED_M).sum()),
    )


def most_different(differences: list[Differences], count: int) -> list[int]:
    """Indices of the frames that differ most; among equals those with more boxes, then the earlier."""
    order = sorted(
        range(len(differences)),
        key=lambda index: (-differences[index].count, -len(differences[index].reference), index),
    )
    return order[:count]


def draw_differences(frame: StereoFrame, differences: Differences, names: tuple[str, str]) -> Image:
    """The picture of one frame.

    Args:
        frame: what both models saw.
        differences: their boxes.
        names: of the reference and the other.

    Returns:
        (H, W, 3) uint8 BGR.
    """
    scale = CAMERA_WIDTH_PX / frame.size_wh[0]
    camera_wh = (CAMERA_WIDTH_PX, max(1, round(frame.size_wh[1] * scale)))
    height = 3 * CAPTION_PX + 2 * camera_wh[1]
    canvas = np.empty((height, CAMERA_WIDTH_PX + BIRD_EYE_WIDTH_PX, 3), dtype=np.uint8)
    canvas[:] = BACKGROUND
    projection = frame.geometry.scale((scale, camera_wh[1] / frame.size_wh[1]), camera_wh).P2
    small = cv2.resize(frame.left, camera_wh, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    rows = (
        (f"{names[0]} (reference)", differences.reference, differences.reference_colours),
        (names[1], differences.other, differences.other_colours),
    )
    top = 0
    for caption, boxes, colours in rows:
        _caption(canvas, f"frame {frame.frame_id}: {caption}, {len(boxes)} boxes", (10, top), TEXT)
        view = small.copy()
        _draw_boxes(view, projection, boxes, colours)
        canvas[top + CAPTION_PX : top + CAPTION_PX + camera_wh[1], :CAMERA_WIDTH_PX] = view
        top += CAPTION_PX + camera_wh[1]
    column = 10
    for name, colour in LEGEND:
        column += _caption(canvas, name, (column, top), colour) + 24
    canvas[:, CAMERA_WIDTH_PX:] = _from_above(frame, differences, height)
    return canvas


def _caption(canvas: Image, text: str, corner_xy: tuple[int, int], colour: Colour) -> int:
    baseline = corner_xy[1] + CAPTION_PX - 11
    return draw_text(canvas, text, (corner_xy[0], baseline), colour=colour, size_px=TEXT_PX)


def _draw_boxes(image: Image, projection: FloatArray, boxes: Detections3D, colours: tuple[Colour, ...]) -> None:
    corners = box_corners(boxes.center_in_camera, boxes.size_hwl, boxes.yaw_rad)
    for row in np.argsort(-boxes.center_in_camera[:, 2]):
        pixels, depth_m = project_to_image(projection, corners[row])
        if (depth_m < NEAR_M).any():  # it reaches behind the camera and has no outline in the image
            continue
        width = 1 if colours[row] == AGREED else 2
        for start, end in EDGES:
            draw_line(image, pixels[start], pixels[end], colour=colours[row], width=width)


def _from_above(frame: StereoFrame, differences: Differences, height: int) -> Image:
    view = BirdEyeView((BIRD_EYE_WIDTH_PX, height))
    panel = view.draw(frame.geometry, Detections3D.empty(differences.reference.class_names), None)
    for boxes, colours, width in (
        (differences.reference, differences.reference_colours, 1),
        (differences.other, differences.other_colours, 2),
    ):
        for ground_xz, colour in zip(footprints(boxes), colours, strict=True):
            draw_outline(panel, view.to_panel(ground_xz), colour=colour, width=width)
    return panel
