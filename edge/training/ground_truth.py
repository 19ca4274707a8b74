"""Labelled objects as the head sees them: boxes of the network image with depth, size, angle (paper, III-A)."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from runtime.boxcode import FloatArray32
from runtime.contracts.geometry import FloatArray, StereoGeometry, project_to_image
from runtime.contracts.kitti import MISSING_ALPHA_RAD
from runtime.contracts.objects import Objects3D, box_corners, wrap_angle_rad

NEIGHBOUR_CLASSES = {"Car": ("Van",), "Pedestrian": ("Person_sitting",)}
MIN_CORNER_DEPTH_M = 0.5


@dataclass(frozen=True, slots=True)
class ObjectLimits:
    """Objects beyond these teach nothing: anchors on them are ignored."""

    max_truncation: float = 1.0
    max_occlusion: int = 3
    min_box_height_px: float = 0.0
    ignore_neighbours: bool = False


@dataclass(frozen=True, slots=True)
class GroundTruth:
    """Objects of one network image.

    Attributes:
        boxes: (G, 11) float32, the columns of `runtime.boxcode`: x1 y1 x2 y2 cx cy z w h l alpha.
        class_index: (G,) int64, into the preset's classes.
        ignore_boxes: (I, 4) float32 xyxy: look-alike classes and objects beyond the limits.
        ignore_regions: (R, 4) float32 xyxy: DontCare.
    """

    boxes: FloatArray32
    class_index: NDArray[np.int64]
    ignore_boxes: FloatArray32
    ignore_regions: FloatArray32


def outline_boxes(objects: Objects3D, P2: FloatArray) -> FloatArray:
    """(N, 4) bounding boxes of the eight projected corners, not cut at the image (official behaviour).

    The boxes are turned as decoding turns them, ``alpha + atan2(X + t_x / f_x, Z)``, not by the label's yaw.
    Corners nearer than half a metre, or behind the camera, are taken at that depth.
    """
    center = objects.center_in_camera
    turned_rad = objects.alpha_rad + np.arctan2(center[:, 0] + P2[0, 3] / P2[0, 0], center[:, 2])
    corners = box_corners(center, objects.size_hwl, turned_rad)
    corners[..., 2] = np.maximum(corners[..., 2], MIN_CORNER_DEPTH_M)
    pixels, _ = project_to_image(P2, corners)
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)


def ground_truth(
    objects: Objects3D,
    classes: tuple[str, ...],
    *,
    geometry: StereoGeometry,
    limits: ObjectLimits,
    dont_care_in_network: FloatArray,
) -> GroundTruth:
    """Turn labels into what the head regresses.

    Args:
        objects: labels of the frame (mirrored with it, if it is).
        classes: the preset's classes.
        geometry: of the network image.
        limits: which objects count.
        dont_care_in_network: (R, 4) DontCare boxes in network pixels.
    """
    boxes2d = outline_boxes(objects, geometry.P2)
    projected, depth_m = project_to_image(geometry.P2, objects.center_in_camera)
    names = np.array([objects.class_names[index] for index in objects.class_id], dtype=object)
    wanted = np.array([name in classes for name in names], dtype=bool)
    within = (
        (objects.truncation <= limits.max_truncation)
        & (objects.occlusion <= limits.max_occlusion)
        & (boxes2d[:, 3] - boxes2d[:, 1] >= limits.min_box_height_px)
        & (depth_m > MIN_CORNER_DEPTH_M)
    )
    neighbours = {other for name in classes for other in NEIGHBOUR_CLASSES.get(name, ())} - set(classes)
    alike = np.array([limits.ignore_neighbours and name in neighbours for name in names], dtype=bool)
    taught = wanted & within
    height, width, length = objects.size_hwl.T
    columns = [
        boxes2d,
        projected,
        depth_m[:, None],
        width[:, None],
        height[:, None],
        length[:, None],
        objects.alpha_rad[:, None],
    ]
    return GroundTruth(
        boxes=np.concatenate(columns, axis=1)[taught].astype(np.float32),
        class_index=np.array([classes.index(name) for name in names[taught]], dtype=np.int64),
        ignore_boxes=boxes2d[(wanted & ~within) | alike].astype(np.float32),
        ignore_regions=(dont_care_in_network if limits.ignore_neighbours else np.zeros((0, 4))).astype(np.float32),
    )


def mirror_geometry(geometry: StereoGeometry, *, exchange: bool = True) -> StereoGeometry:
    """The pair flipped left to right, with the cameras' roles exchanged; or each alone, for a single view."""
    width = geometry.image_size_wh[0]
    flipped = []
    for matrix in (geometry.P3, geometry.P2) if exchange else (geometry.P2, geometry.P3):
        P = matrix.copy()
        P[0, 3] = -P[0, 3]
        P[0, 2] = width - 1 - P[0, 2]
        flipped.append(P)
    return StereoGeometry(flipped[0], flipped[1], geometry.image_size_wh)


def mirror_objects(objects: Objects3D, mirrored_P2: FloatArray) -> Objects3D:
    """Objects of a mirrored pair: X negated, yaw turned, alpha recomputed for the new left camera.

    2D boxes are left as they are: training takes the outline of the projected box.
    """
    center = objects.center_in_camera * np.array([-1.0, 1.0, 1.0])
    yaw = wrap_angle_rad(np.pi - objects.yaw_rad)
    values = {name: getattr(objects, name) for name in objects.__dataclass_fields__}
    return alpha_of_yaw(Objects3D(**{**values, "center_in_camera": center, "yaw_rad": yaw}), mirrored_P2)


def with_every_alpha(objects: Objects3D, P2: FloatArray) -> Objects3D:
    """Objects whose alpha is not given get what their yaw says."""
    given = objects.alpha_rad != MISSING_ALPHA_RAD
    alpha = np.where(given, objects.alpha_rad, alpha_of_yaw(objects, P2).alpha_rad)
    return objects if given.all() else replace(objects, alpha_rad=alpha)


def alpha_of_yaw(objects: Objects3D, P2: FloatArray) -> Objects3D:
    """Objects whose alpha is what decoding turns into their yaw: ``yaw - atan2(X + t_x / f_x, Z)``.

    Labels count alpha from the reference camera, decoding from the left one; the official code recomputes it for mono.
    """
    center = objects.center_in_camera
    alpha = wrap_angle_rad(objects.yaw_rad - np.arctan2(center[:, 0] + P2[0, 3] / P2[0, 0], center[:, 2]))
    return replace(objects, alpha_rad=alpha)
