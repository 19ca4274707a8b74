"""3D boxes projected on the camera image: faces that look at the camera bright, edges behind them faint, a
tag each.

Boxes that reach behind the camera are cut at a plane in front of it before projection.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, project_to_image
from runtime.contracts.objects import Detections3D, Objects3D, box_corners
from runtime.sinks.palette import BACKGROUND, LABEL, Colour, class_colour
from runtime.sinks.shapes import draw_line, fill_chip, fill_polygon
from runtime.sinks.text import BOLD, draw_text, text_width

NEAR_M = 0.4
THIN_BEYOND_M = 35.0
"""Further boxes are small: a thin line leaves something of the object to see."""
# Corner numbers of `box_corners`; each face's corners go round it. The front looks along the object's length.
FRONT, REAR = (4, 5, 6, 3), (0, 1, 2, 7)
FACES = (FRONT, REAR, (0, 1, 4, 5), (7, 2, 3, 6), (0, 5, 6, 7), (1, 2, 3, 4))
EDGES = tuple(
    sorted({(min(pair), max(pair)) for face in FACES for pair in zip(face, (*face[1:], face[0]), strict=True)})
)
TAG_PX = 14
_TAG_PADDING_PX = 4
_TAG_GAP_PX = 2
_TAG_RISE_PX = 6
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
    tags: list[_Tag] = []
    for row in np.argsort(distance_m):
        name = detections.class_names[detections.class_id[row]]
        text = f"{name} {detections.score[row]:.2f}  {distance_m[row]:.0f} m"
        top = _top_of(projection, corners[row])
        tag = None if top is None else _place_tag(text, top, colours[row], image_size_wh=image.shape[1::-1], tags=tags)
        tags += [] if tag is None else [tag]
    _draw_tags(image, tags)


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
    width = 2 if np.linalg.norm(middle - camera) < THIN_BEYOND_M else 1
    for edge in bright:
        _draw_edge(image, projection, corners[list(edge)], colour, width)
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


@dataclass(frozen=True, slots=True)
class _Tag:
    """A chip with text, and the point that it is about."""

    text: str
    colour: Colour
    corner_xy: tuple[int, int]
    size_wh: tuple[int, int]
    about_xy: FloatArray

    def meets(self, corner_xy: tuple[int, int], size_wh: tuple[int, int]) -> bool:
        """Whether another chip there would touch it."""
        return all(
            other < own + own_size + _TAG_GAP_PX and own < other + other_size + _TAG_GAP_PX
            for own, own_size, other, other_size in zip(self.corner_xy, self.size_wh, corner_xy, size_wh, strict=True)
        )


def _place_tag(
    text: str, top_xy: FloatArray, colour: Colour, *, image_size_wh: tuple[int, ...], tags: list[_Tag]
) -> _Tag | None:
    """Room above a point, further up where other tags are; None where there is none."""
    width, height = text_width(text, size_px=TAG_PX, weight=BOLD) + 2 * _TAG_PADDING_PX, TAG_PX + _TAG_PADDING_PX
    x = round(float(np.clip(top_xy[0] - width / 2, 0, max(image_size_wh[0] - width - 1, 0))))
    y = round(float(top_xy[1])) - height - _TAG_RISE_PX
    if not -height < y < image_size_wh[1] or not 0 <= top_xy[0] < image_size_wh[0]:
        return None
    for attempt in range(_TAG_TRIES):
        corner = (x, max(y - attempt * (height + _TAG_GAP_PX), 0))
        if not any(tag.meets(corner, (width, height)) for tag in tags):
            return _Tag(text, colour, corner, (width, height), top_xy)
    return None


def _draw_tags(image: Image, tags: list[_Tag]) -> None:
    """Lines first, so that none runs through a text."""
    for tag in tags:
        bottom = tag.corner_xy[1] + tag.size_wh[1]
        if tag.about_xy[1] - bottom > _TAG_RISE_PX + 1:
            anchor = np.array([np.clip(tag.about_xy[0], tag.corner_xy[0], tag.corner_xy[0] + tag.size_wh[0]), bottom])
            draw_line(image, anchor, tag.about_xy, colour=tag.colour)
    for tag in tags:
        fill_chip(image, tag.corner_xy, tag.size_wh, colour=tag.colour)
        baseline = (tag.corner_xy[0] + _TAG_PADDING_PX, tag.corner_xy[1] + tag.size_wh[1] - _TAG_PADDING_PX)
        draw_text(image, tag.text, baseline, colour=BACKGROUND, size_px=TAG_PX, weight=BOLD)


def fit_to_width(image: Image, size_wh: tuple[int, int]) -> Image:
    """The camera image in the size in which it is drawn on."""
    shrinking = size_wh[0] < image.shape[1]
    resized = cv2.resize(image, size_wh, interpolation=cv2.INTER_AREA if shrinking else cv2.INTER_LINEAR)
    pixels: Image = resized.astype(np.uint8, copy=False)
    return pixels
