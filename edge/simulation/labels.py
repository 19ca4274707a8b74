"""Exact KITTI labels of placed objects.

The 2D box is that of the object's whole outline, hidden parts included, cut to the image; truncation is the share of
the uncut box that lies outside. Occlusion comes from counted pixels: at least 0.80 of the outline inside the image
seen: 0; at least 0.40: 1; less: 2. An object becomes DontCare where it is under 16 px high, less than a tenth of it is
to be seen (hidden, or beyond the image's edge), or farther than 90 m; without a single visible pixel it has no line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.simulation.placing import PlacedObject
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import Objects3D, wrap_angle_rad

FloatArray = NDArray[np.float64]
FULLY_SEEN, PARTLY_SEEN, HARDLY_SEEN = 0.80, 0.40, 0.10
SMALLEST_PX, FARTHEST_M = 16.0, 90.0
_NEAR_M = 0.2  # outlines are cut at this depth before they are projected


@dataclass(frozen=True, slots=True)
class Outline:
    """The projected extent of a mesh.

    Attributes:
        box: (4,) x1 y1 x2 y2 cut to the image, pixels; empty where nothing lies inside.
        truncation: share of the uncut box outside the image.
    """

    box: FloatArray
    truncation: float


def outline(geometry: StereoGeometry, points_in_camera: FloatArray, triangles: NDArray[np.int32]) -> Outline | None:
    """Extent of a mesh in the left image; None where all of it lies behind the near plane.

    Args:
        geometry: the rig.
        points_in_camera: (V, 3) vertices in the reference camera frame, metres.
        triangles: (T, 3).
    """
    homogeneous = points_in_camera @ geometry.P2[:, :3].T + geometry.P2[:, 3]
    depth = homogeneous[:, 2]
    front = depth >= _NEAR_M
    if not front.any():
        return None
    kept = homogeneous[front]
    if not front.all():
        starts, ends = triangles.reshape(-1), np.roll(triangles, -1, axis=1).reshape(-1)
        crossing = front[starts] != front[ends]
        a, b = homogeneous[starts[crossing]], homogeneous[ends[crossing]]
        share = (_NEAR_M - a[:, 2]) / (b[:, 2] - a[:, 2])
        kept = np.concatenate([kept, a + share[:, None] * (b - a)])
    pixels = kept[:, :2] / kept[:, 2:3]
    uncut = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    width, height = geometry.image_size_wh
    limit = np.array([width - 1.0, height - 1.0])
    low, high = np.clip(uncut[:2], 0.0, limit), np.clip(uncut[2:], 0.0, limit)
    area = float(np.prod(uncut[2:] - uncut[:2]))
    truncation = 1.0 - float(np.prod(high - low)) / area if area > 0 else 1.0
    return Outline(np.concatenate([low, high]), float(np.clip(truncation, 0.0, 1.0)))


def label_objects(
    objects: Sequence[PlacedObject],
    *,
    geometry: StereoGeometry,
    camera_from_world: FloatArray,
    pixels: dict[int, tuple[int, int]],
) -> Objects3D:
    """The frame's labels.

    Args:
        objects: all placed objects.
        geometry: the rig.
        camera_from_world: (4, 4) to the reference camera; turns about y only.
        pixels: object id -> (visible, total) pixels in the left image.
    """
    rows: list[tuple[PlacedObject, Outline, int, FloatArray, float]] = []
    regions: list[FloatArray] = []
    turn_rad = float(np.arctan2(camera_from_world[0, 2], camera_from_world[0, 0]))
    for item in objects:
        visible, total = pixels.get(item.object_id, (0, 0))
        if visible == 0 or total == 0:
            continue
        mesh = item.body.phases[item.phase]
        camera_from_model = camera_from_world @ item.world_from_model()
        points = mesh.positions @ camera_from_model[:3, :3].T + camera_from_model[:3, 3]
        seen = outline(geometry, points, mesh.triangles)
        if seen is None or (seen.box[2:] - seen.box[:2]).min() < 1.0:
            continue
        bottom = camera_from_world[:3, :3] @ np.array(item.location) + camera_from_world[:3, 3]
        share = visible / total
        too_small = seen.box[3] - seen.box[1] < SMALLEST_PX
        if too_small or share < HARDLY_SEEN or seen.truncation > 1.0 - HARDLY_SEEN or bottom[2] > FARTHEST_M:
            regions.append(seen.box)
            continue
        level = 0 if share >= FULLY_SEEN else 1 if share >= PARTLY_SEEN else 2
        rows.append((item, seen, level, bottom, item.yaw_rad + turn_rad))
    if not rows:
        empty = Objects3D.empty(KITTI_CLASSES)
        values = {name: getattr(empty, name) for name in empty.__dataclass_fields__}
        return Objects3D(**{**values, "dont_care_boxes": np.array(regions).reshape(-1, 4)})
    bottoms = np.array([row[3] for row in rows])
    sizes = np.array([row[0].size_hwl for row in rows])
    yaw = wrap_angle_rad(np.array([row[4] for row in rows]))
    return Objects3D(
        class_id=np.array([KITTI_CLASSES.index(row[0].kind) for row in rows]),
        box_in_left_image=np.array([row[1].box for row in rows]),
        center_in_camera=bottoms - np.stack([np.zeros(len(rows)), 0.5 * sizes[:, 0], np.zeros(len(rows))], axis=1),
        size_hwl=sizes,
        alpha_rad=wrap_angle_rad(yaw - np.arctan2(bottoms[:, 0], bottoms[:, 2])),
        yaw_rad=yaw,
        truncation=np.array([row[1].truncation for row in rows]),
        occlusion=np.array([row[2] for row in rows]),
        track_id=np.array([row[0].object_id - 1 for row in rows]),
        dont_care_boxes=np.array(regions).reshape(-1, 4),
        class_names=KITTI_CLASSES,
    )
