"""Where in a frame another object can stand: on its ground, in front of all that matching sees, beside its objects."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.training.disparity_targets import grey_of
from edge.training.object_masks import disparity_at
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray, StereoGeometry, project_to_image
from runtime.contracts.objects import Objects3D, ground_corners

HALF = 2  # the scene is matched at half the size
SCENE_DISPARITIES, SCENE_BLOCK_PX = 64, 15
CAMERA_HEIGHT_M = 1.65
HEIGHT_SPREAD_M, SLOPE_SPREAD, BOTTOM_SPREAD_M = 0.1, 0.012, 0.12
NEARER_SLACK_PX = 1.0  # full-size pixels
MAX_NEARER_SHARE = 0.04
GROUND_SLACK_PX = 1.6
MIN_GROUND_SHARE = 0.12  # of the patch under an object that must have been matched
GAP_M = 0.35  # between footprints


@dataclass(frozen=True, slots=True)
class Ground:
    """The plane that a frame's objects stand on: ``y = height_m + slope z`` in the labels' camera."""

    height_m: float
    slope: float

    def y_at(self, depth_m: float) -> float:
        """Height coordinate of the ground, metres down from the camera."""
        return self.height_m + self.slope * depth_m


def ground_of(objects: Objects3D) -> Ground:
    """The most likely plane, given where the labelled objects stand and how cameras are mounted on cars."""
    near = objects.center_in_camera[:, 2] < 45.0
    depth_m = objects.center_in_camera[near, 2]
    bottom_m = (objects.center_in_camera[:, 1] + objects.size_hwl[:, 0] / 2)[near]
    rows = np.stack([np.ones_like(depth_m), depth_m], axis=1) / BOTTOM_SPREAD_M
    prior = np.diag([1 / HEIGHT_SPREAD_M, 1 / SLOPE_SPREAD])
    wanted = np.concatenate([(bottom_m - CAMERA_HEIGHT_M) / BOTTOM_SPREAD_M, np.zeros(2)])
    found, *_ = np.linalg.lstsq(np.concatenate([rows, prior]), wanted, rcond=None)
    return Ground(CAMERA_HEIGHT_M + float(found[0]), float(found[1]))


def scene_disparity(frame: StereoFrame) -> NDArray[np.float32]:
    """(H / 2, W / 2) disparity of the left view in full-size pixels, negative where nothing matched."""
    assert frame.right is not None
    size_wh = frame.size_wh[0] // HALF, frame.size_wh[1] // HALF
    left, right = (grey_of(cv2.resize(v, size_wh, interpolation=cv2.INTER_AREA)) for v in (frame.left, frame.right))
    matcher = cv2.StereoBM.create(numDisparities=SCENE_DISPARITIES, blockSize=SCENE_BLOCK_PX)
    matched: NDArray[np.float32] = matcher.compute(left, right).astype(np.float32) * np.float32(HALF / 16)
    return matched


def is_in_front(scene: NDArray[np.float32], box: FloatArray, disparity_px: float) -> bool:
    """Whether nearly nothing of the scene within a box is nearer than an object of that disparity.

    Args:
        scene: of `scene_disparity`.
        box: (4,) xyxy, full-size pixels.
        disparity_px: of the object, full-size pixels.
    """
    within = _part(scene, box)
    if within.size == 0:
        return False
    return bool((within > disparity_px * 1.03 + NEARER_SLACK_PX).mean() <= MAX_NEARER_SHARE)


def is_on_ground(
    scene: NDArray[np.float32], geometry: StereoGeometry, *, center: FloatArray, size_hwl: FloatArray, ground: Ground
) -> bool:
    """Whether the scene, where an object would touch the ground, is as far away as that ground.

    Looks at the patch of the image that the ground around the footprint covers.
    """
    reach = max(float(size_hwl[1:].min()) / 2 + 0.3, 0.8)
    x, z = float(center[0]), float(center[2])
    spots = np.array(
        [(x + dx, ground.y_at(z + dz), z + dz) for dx in (-reach, 0.0, reach) for dz in (-reach, 0.0, reach)]
    )
    pixels, _ = project_to_image(geometry.P2, spots)
    box = np.concatenate([pixels.min(axis=0), pixels.max(axis=0)])
    box[3] += HALF
    patch = _part(scene, box)
    if patch.size < 4:
        return False
    rows = (np.arange(patch.shape[0]) + max(int(box[1]) // HALF, 0) + 0.5) * HALF
    # a ground pixel's ray: y = (v - c_v) z / f = height + slope z
    per_metre = np.maximum((rows - geometry.P2[1, 2]) / geometry.P2[1, 1] - ground.slope, 1e-6)
    expected = disparity_at(geometry, ground.height_m / per_metre)
    known = patch > 0
    off = np.abs(patch - expected[:, None])
    matched_share = float(known.mean())
    return matched_share >= MIN_GROUND_SHARE and bool((off[known] <= GROUND_SLACK_PX).mean() >= 0.7)


def footprints_apart(footprint: FloatArray, others: list[FloatArray]) -> bool:
    """Whether a footprint (4, 2) keeps its distance from others: some edge's normal separates each pair."""
    return all(_separated(footprint, other) for other in others)


def footprint_of(center: FloatArray, size_hwl: FloatArray, yaw_rad: float) -> FloatArray:
    """(4, 2) x and z of a box's corners on the ground, the gap to neighbours added."""
    (corners,) = ground_corners(center[None, [0, 2]], size_hwl[None, [2, 1]] + GAP_M, np.array([yaw_rad]))
    return corners


def _separated(one: FloatArray, other: FloatArray) -> bool:
    for shape in (one, other):
        for edge in (shape[1] - shape[0], shape[2] - shape[1]):
            normal = np.array([-edge[1], edge[0]])
            a, b = one @ normal, other @ normal
            if a.max() < b.min() or b.max() < a.min():
                return True
    return False


def _part(scene: NDArray[np.float32], box: FloatArray) -> NDArray[np.float32]:
    x1, y1, x2, y2 = (int(value) // HALF for value in box)
    return scene[max(y1, 0) : max(y2, 0) + 1, max(x1, 0) : max(x2, 0) + 1]
