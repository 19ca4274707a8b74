"""3D boxes projected on the camera image: faces that look at the camera bright, edges behind them faint, a
tag each.

Boxes that reach behind the camera are cut at a plane in front of it before projection.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, project_to_image
from runtime.contracts.objects import Detections3D, Objects3D, box_corners
from runtime.sinks.palette import BACKGROUND, LABEL, Colour, class_colour
from runtime.sinks.shapes import draw_line, fill_chip, fill_polygon
from runtime.sinks.text import BOLD, draw_text, text_width

NEAR_M = 0.4
# Corner numbers of `box_corners`; each face's corners go round it. The front looks along the object's length.
FRONT, REAR = (4, 5, 6, 3), (0, 1, 2, 7)
FACES = (FRONT, REAR, (0, 1, 4, 5), (7, 2, 3, 6), (0, 5, 6, 7), (1, 2, 3, 4))
EDGES = tuple(
    sorted({(min(pair), max(pair)) for face in FACES for pair in zip(face, (*face[1:], face[0]), strict=True)})
)
TAG_PX = 14
_TAG_PADDING_PX = 4
_TAG_GAP_PX = 2
_TAG_TRIES = 3

Image = NDArray[np.uint8]


def draw_boxes(image: Image, projection: FloatArray, detections: Detections3D) -> None:
    """Draws detections far to near, then their tags near to far.

    Args:
        image: (H, W, 3) uint8 BGR, drawn on.
        projection: (3, 4), camera frame to pixels of this image.
        detections: boxes; tags show class, score and distance in metres.
    """
    distance_m = np.linalg.norm(detections.center_in_camera, axis=1)
    corners = box_corners(detections.center_in_camera, detections.size_hwl, detections.yaw_rad)
    colours = [class_colour(detections.class_names[index]) for index in detections.class_id]
    for row in np.argsort(-distance_m):
        _draw_box(image, projection, corners[row], colours[row])
    taken: list[tuple[int, int, int, int]] = []
    for row in np.argsort(distance_m):
        name = detections.class_names[detections.class_id[row]]
        text = f"{name} {detections.score[row]:.2f}  {distance_m[row]:.0f} m"
        top = _top_of(projection, corners[row])
        if top is not None:
            _draw_tag(image, text, top, colours[row], taken)


def draw_label_boxes(image: Image, projection: FloatArray, labels: Objects3D) -> None:
    """Draws true boxes as thin white wires."""
    corners = box_corners(labels.center_in_camera, labels.size_hwl, labels.yaw_rad)
    for box in corners:
        for start, end in EDGES:
            _draw_edge(image, projection, box[[start, end]], LABEL, 1)


def _draw_box(image: Image, projection: FloatArray, corners: FloatArray, colour: Colour) -> None:
    camera = -np.linalg.solve(projection[:, :3], projection[:, 3])
    middle = corners.mean(axis=0)
    visible = []
    for face in FACES:
        center = corners[list(face)].mean(axis=0)
        if np.dot(center - middle, camera - center) > 0:
            visible.append(face)
            outline = _project_polygon(projection, corners[list(face)])
            fill_polygon(image, outline, colour=colour, opacity=0.30 if face == FRONT else 0.12)
    bright = {(min(pair), max(pair)) for face in visible for pair in zip(face, (*face[1:], face[0]), strict=True)}
    faint: Colour = (colour[0] * 6 // 10, colour[1] * 6 // 10, colour[2] * 6 // 10)
    for edge in EDGES:
        if edge not in bright:
            _draw_edge(image, projection, corners[list(edge)], faint, 1)
    for edge in bright:
        _draw_edge(image, projection, corners[list(edge)], colour, 2)
    if FRONT in visible:  # a cross on the front tells where the object looks
        for pair in ((4, 6), (5, 3)):
            _draw_edge(image, projection, corners[list(pair)], colour, 1)


def _draw_edge(image: Image, projection: FloatArray, ends: FloatArray, colour: Colour, width: int) -> None:
    """A line between two camera-frame points (2, 3), without what lies behind the near plane."""
    depth = ends @ projection[2, :3] + projection[2, 3]
    if (depth < NEAR_M).all():
        return
    if (depth < NEAR_M).any():
        behind = int(np.argmin(depth))
        share = (NEAR_M - depth[behind]) / (depth[1 - behind] - depth[behind])
        ends = ends.copy()
        ends[behind] += share * (ends[1 - behind] - ends[behind])
    pixels, _ = project_to_image(projection, ends)
    draw_line(image, pixels[0], pixels[1], colour=colour, width=width)


def _project_polygon(projection: FloatArray, points: FloatArray) -> FloatArray:
    """Pixels (M, 2) of a planar polygon (N, 3) cut at the near plane; M may be 0."""
    depth = points @ projection[2, :3] + projection[2, 3]
    kept: list[FloatArray] = []
    for index in range(len(points)):
        follower = (index + 1) % len(points)
        if depth[index] >= NEAR_M:
            kept.append(points[index])
        if (depth[index] >= NEAR_M) != (depth[follower] >= NEAR_M):
            share = (NEAR_M - depth[index]) / (depth[follower] - depth[index])
            kept.append(points[index] + share * (points[follower] - points[index]))
    if len(kept) < 3:
        return np.zeros((0, 2))
    return project_to_image(projection, np.stack(kept))[0]


def _top_of(projection: FloatArray, corners: FloatArray) -> FloatArray | None:
    """Where a tag belongs: above the projected box; None where the box reaches behind the camera."""
    pixels, depth = project_to_image(projection, corners)
    if (depth < NEAR_M).any():
        return None
    return np.array([0.5 * (pixels[:, 0].min() + pixels[:, 0].max()), pixels[:, 1].min()])


def _draw_tag(
    image: Image,
    text: str,
    top_xy: FloatArray,
    colour: Colour,
    taken: list[tuple[int, int, int, int]],
) -> None:
    """A chip with text above a point, moved up past earlier ones; left out where there is no room."""
    width = text_width(text, size_px=TAG_PX, weight=BOLD) + 2 * _TAG_PADDING_PX
    height = TAG_PX + _TAG_PADDING_PX
    x = round(float(np.clip(top_xy[0] - width / 2, 0, max(image.shape[1] - width - 1, 0))))
    y = round(float(top_xy[1])) - height - 6
    if not -height < y < image.shape[0] or not 0 <= top_xy[0] < image.shape[1]:
        return
    for attempt in range(_TAG_TRIES):
        place = (x, max(y - attempt * (height + _TAG_GAP_PX), 0))
        if not any(_overlap((*place, width + _TAG_GAP_PX, height + _TAG_GAP_PX), other) for other in taken):
            break
    else:
        return
    taken.append((*place, width + _TAG_GAP_PX, height + _TAG_GAP_PX))
    if place[1] < y - 1:
        anchor = np.array([float(np.clip(top_xy[0], x, x + width)), place[1] + height])
        draw_line(image, anchor, top_xy, colour=colour)
    fill_chip(image, place, (width, height), colour=colour)
    baseline = (place[0] + _TAG_PADDING_PX, place[1] + height - _TAG_PADDING_PX)
    draw_text(image, text, baseline, colour=BACKGROUND, size_px=TAG_PX, weight=BOLD)


def _overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> bool:
    return (
        one[0] < other[0] + other[2]
        and other[0] < one[0] + one[2]
        and one[1] < other[1] + other[3]
        and other[1] < one[1] + one[3]
    )


def fit_to_width(image: Image, size_wh: tuple[int, int]) -> Image:
    """The camera image in the size in which it is drawn on."""
    shrinking = size_wh[0] < image.shape[1]
    resized = cv2.resize(image, size_wh, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
    pixels: Image = resized.astype(np.uint8, copy=False)
    return pixels
