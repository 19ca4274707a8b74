"""Zooming into or out of a pair with depth to match, so that labels, projections and pixels agree exactly.

A model that looks at every camera at one focal length takes a picture magnified by s for the same camera's picture of
a scene whose depths are Z / s: ``s f X / Z = f X / (Z / s)``, and disparity ``s f b / Z = f b / (Z / s)`` with the
baseline as it is. So focal length and baseline stay and the scene is squeezed along the viewing axis: widths, heights
and the camera's height above the road keep their metres. (Keeping Z and raising the focal length would be as true, but
such a model brings any focal length back to its own; keeping both would teach a wrong depth.) A box that is turned
becomes a parallelogram; its label is the rectangle along the squeezed length with the same area.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Objects3D, wrap_angle_rad

FACTOR_LIMITS = (0.93, 1.18)  # out: rows are missing below; in: cars grow shorter than cars are


@dataclass(frozen=True, slots=True)
class Zoom:
    """``x' = factor x - left``, ``y' = factor y - top``, in an image of ``size_wh``."""

    factor: float
    left: float
    top: float
    size_wh: tuple[int, int]


def draw_zoom(geometry: StereoGeometry, rng: np.random.Generator) -> Zoom:
    """A factor, and where the window lies: in, anywhere across with the horizon's row kept; out, the whole picture."""
    factor = float(np.exp(rng.uniform(*np.log(FACTOR_LIMITS))))
    across = float(rng.random())
    width, height = geometry.image_size_wh
    if factor < 1.0:
        return Zoom(factor, 0.0, 0.0, (int(width * factor), int(height * factor)))
    row = geometry.principal_point_px[1]
    return Zoom(factor, across * (factor - 1.0) * width, (factor - 1.0) * row, (width, height))


def zoomed(frame: StereoFrame, objects: Objects3D, zoom: Zoom) -> tuple[StereoFrame, Objects3D]:
    """Apply a zoom to pixels, projections and labels; objects that leave the picture leave the labels.

    Args:
        frame: a pair, or a single view.
        objects: its labels.
        zoom: of `draw_zoom`.
    """
    images = [None if image is None else _warped(image, zoom) for image in (frame.left, frame.right)]
    assert images[0] is not None
    changed = replace(frame, left=images[0], right=images[1], geometry=zoomed_geometry(frame.geometry, zoom))
    return changed, zoomed_objects(objects, zoom)


def zoomed_geometry(geometry: StereoGeometry, zoom: Zoom) -> StereoGeometry:
    """Projections of the squeezed scene: ``S P diag(1, 1, s, 1) / s``; focal length and baseline stay."""
    change = np.array([[zoom.factor, 0.0, -zoom.left], [0.0, zoom.factor, -zoom.top], [0.0, 0.0, 1.0]])
    squeeze = np.diag([1.0, 1.0, zoom.factor, 1.0])
    P2, P3 = (change @ P @ squeeze / zoom.factor for P in (geometry.P2, geometry.P3))
    return StereoGeometry(P2, P3, zoom.size_wh)


def zoomed_objects(objects: Objects3D, zoom: Zoom) -> Objects3D:
    """Labels of the squeezed scene; truncation counts what the window cuts off."""
    factor = zoom.factor
    center = objects.center_in_camera / [1.0, 1.0, factor]
    cos, sin = np.cos(objects.yaw_rad), np.sin(objects.yaw_rad) / factor
    stretch = np.hypot(cos, sin)
    height, width, length = objects.size_hwl.T
    yaw_rad = np.arctan2(sin, cos)
    ray_rad = [np.arctan2(spot[:, 0], spot[:, 2]) for spot in (objects.center_in_camera, center)]
    alpha_rad = wrap_angle_rad(objects.alpha_rad + (yaw_rad - objects.yaw_rad) - (ray_rad[1] - ray_rad[0]))
    boxes, visible = _in_window(objects.box_in_left_image, zoom)
    regions, region_visible = _in_window(objects.dont_care_boxes, zoom)
    changed = replace(
        objects,
        center_in_camera=center,
        size_hwl=np.stack([height, width / (factor * stretch), length * stretch], axis=1),
        yaw_rad=yaw_rad,
        alpha_rad=alpha_rad,
        box_in_left_image=boxes,
        truncation=1.0 - (1.0 - objects.truncation) * visible,
        dont_care_boxes=regions[region_visible > 0],
    )
    return changed.select(visible > 0)


def _warped(image: NDArray[np.uint8], zoom: Zoom) -> NDArray[np.uint8]:
    matrix = np.array([[zoom.factor, 0.0, -zoom.left], [0.0, zoom.factor, -zoom.top]])
    warped: NDArray[np.uint8] = cv2.warpAffine(
        image, matrix, zoom.size_wh, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return warped


def _in_window(boxes: FloatArray, zoom: Zoom) -> tuple[FloatArray, FloatArray]:
    """(N, 4) boxes cut at the window, and the share of each that lies in it."""
    moved = boxes * zoom.factor - [zoom.left, zoom.top] * 2
    width, height = zoom.size_wh
    cut = np.clip(moved, 0, [width - 1, height - 1] * 2)
    area = (moved[:, 2:] - moved[:, :2]).prod(axis=1)
    share: FloatArray = (cut[:, 2:] - cut[:, :2]).prod(axis=1) / np.maximum(area, 1e-9)
    return cut, np.minimum(share, 1.0)
