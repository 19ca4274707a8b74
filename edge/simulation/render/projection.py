"""Matrices between world, camera and clip space, and which instances a volume holds.

Pixel convention: pixel centre (i, j) is image point u = i, v = j, as in KITTI's P2. Image row 0 is drawn to
framebuffer row 0, so pictures are read back without a flip.

Everything the GPU sees is relative to an origin near the camera, subtracted in float64, so a drive may be
kilometres long without losing millimetres to float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.simulation.scene import PinholeCamera

NEAR_M = 0.15
FAR_M = 1500.0
SHADOW_BEHIND_M = 10.0
SHADOW_AHEAD_M = 90.0
SHADOW_ASIDE_M = 42.0
SHADOW_TALL_M = 10.0  # receivers higher than this above the road may miss shadows
SHADOW_CASTER_REACH_M = 150.0  # how far towards the sun something may stand and still cast
_SMALLEST_SIDEWAYS = 0.05

Matrix = NDArray[np.float64]


def camera_position(camera: PinholeCamera) -> Matrix:
    """Camera centre in the world, (3,) metres."""
    rotation = camera.camera_from_world[:3, :3]
    return -rotation.T @ camera.camera_from_world[:3, 3]


def clip_from_camera(camera: PinholeCamera, *, shift_px: tuple[float, float] = (0.0, 0.0)) -> Matrix:
    """(4, 4) OpenGL clip matrix of a pinhole camera; clip w is the z-depth in metres.

    ``shift_px`` moves the picture right and down: the sample taken at a pixel centre then lies that far left
    and up of it.
    """
    width, height = camera.size_wh
    k = camera.intrinsics
    unit_z = np.array([0.0, 0.0, 1.0])
    matrix = np.zeros((4, 4))
    # window = u + 0.5 (pixel centres of OpenGL lie at half integers), ndc = 2 * window / size - 1
    matrix[0, :3] = 2.0 * (k[0] + (0.5 + shift_px[0]) * unit_z) / width - unit_z
    matrix[1, :3] = 2.0 * (k[1] + (0.5 + shift_px[1]) * unit_z) / height - unit_z
    matrix[2, 2] = (FAR_M + NEAR_M) / (FAR_M - NEAR_M)
    matrix[2, 3] = -2.0 * FAR_M * NEAR_M / (FAR_M - NEAR_M)
    matrix[3, 2] = 1.0
    return matrix


def clip_from_world(camera: PinholeCamera, origin: Matrix, *, shift_px: tuple[float, float] = (0.0, 0.0)) -> Matrix:
    """(4, 4) clip matrix for points relative to ``origin``; ``shift_px`` as in `clip_from_camera`."""
    back = np.eye(4)
    back[:3, 3] = origin
    return clip_from_camera(camera, shift_px=shift_px) @ camera.camera_from_world @ back


def rays_from_clip(camera: PinholeCamera, *, shift_px: tuple[float, float] = (0.0, 0.0)) -> Matrix:
    """(3, 3) matrix taking (ndc x, ndc y, 1) to a world direction, not normalised."""
    width, height = camera.size_wh
    x, y = width / 2, height / 2
    pixel_from_ndc = np.array([[x, 0.0, x - 0.5 - shift_px[0]], [0.0, y, y - 0.5 - shift_px[1]], [0.0, 0.0, 1.0]])
    return camera.camera_from_world[:3, :3].T @ np.linalg.inv(camera.intrinsics) @ pixel_from_ndc


def shadow_clip_from_world(camera: PinholeCamera, towards_sun: Matrix, *, origin: Matrix, texels: int) -> Matrix:
    """(4, 4) orthographic clip matrix of the sun's view of the road ahead, for points relative to origin.

    The covered block reaches from `SHADOW_BEHIND_M` behind to `SHADOW_AHEAD_M` ahead of the camera. Its
    corner is snapped to whole texels of the world, so shadow edges keep still while the camera moves on.
    """
    down_the_light = -np.asarray(towards_sun, float) / np.linalg.norm(towards_sun)
    heading = camera.camera_from_world[2, :3] * np.array([1.0, 0.0, 1.0])
    heading /= np.linalg.norm(heading)
    across = np.cross(down_the_light, heading)
    if np.linalg.norm(across) < _SMALLEST_SIDEWAYS:
        across = np.array([heading[2], 0.0, -heading[0]])
    across /= np.linalg.norm(across)
    along = np.cross(across, down_the_light)
    along /= np.linalg.norm(along)
    axes = np.stack([across, along, down_the_light])  # rows: light frame from world

    right = np.array([heading[2], 0.0, -heading[0]])
    ground = camera_position(camera) * np.array([1.0, 0.0, 1.0])
    corners = [
        ground + heading * ahead + right * aside + np.array([0.0, tall, 0.0])
        for ahead in (-SHADOW_BEHIND_M, SHADOW_AHEAD_M)
        for aside in (-SHADOW_ASIDE_M, SHADOW_ASIDE_M)
        for tall in (1.5, -SHADOW_TALL_M)
    ]
    in_light = np.array(corners) @ axes.T
    low, high = in_light.min(axis=0), in_light.max(axis=0)
    extent = high - low
    texel = np.ceil(extent[:2] / texels * 1000.0) / 1000.0
    extent[:2] = texel * texels
    low[:2] = np.floor(low[:2] / texel) * texel
    low[2] -= SHADOW_CASTER_REACH_M
    extent[2] = high[2] - low[2]

    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * axes / extent[:, None]
    matrix[:3, 3] = -2.0 * low / extent - 1.0 + matrix[:3, :3] @ origin
    return matrix


def volume_planes(clip: Matrix) -> Matrix:
    """(6, 4) planes of a clip volume, normalised: inside is ``plane @ (x, y, z, 1) >= 0``."""
    planes = np.concatenate([clip[3] + clip[:3], clip[3] - clip[:3]])
    return planes / np.linalg.norm(planes[:, :3], axis=1, keepdims=True)


def spheres_inside(clip: Matrix, centres: Matrix, radii: Matrix) -> NDArray[np.bool_]:
    """Which spheres, (N, 3) centres and (N,) radii, touch the clip volume."""
    planes = volume_planes(clip)
    distances = centres @ planes[:, :3].T + planes[:, 3]
    return (distances >= -radii[:, None]).all(axis=1)


def cover_matrices(camera: PinholeCamera, origin: Matrix) -> tuple[Matrix, Matrix]:
    """Matrices of the map that looks straight down on the block that the shadow map covers.

    Returns:
        (4, 4) clip matrix to draw it with (highest wins), and a (4, 4) matrix giving (x, y) in [-1, 1] on
        the map and the height above the origin in metres as z. Both take points relative to ``origin``.
    """
    heading = camera.camera_from_world[2, :3] * np.array([1.0, 0.0, 1.0])
    heading /= np.linalg.norm(heading)
    right = np.array([heading[2], 0.0, -heading[0]])
    half_length = (SHADOW_AHEAD_M + SHADOW_BEHIND_M) / 2
    middle = camera_position(camera) + heading * (SHADOW_AHEAD_M - half_length) - origin
    lookup = np.eye(4)
    lookup[0, :3] = right / SHADOW_ASIDE_M
    lookup[1, :3] = heading / half_length
    lookup[:2, 3] = -lookup[:2, :3] @ middle
    lookup[2] = [0.0, -1.0, 0.0, 0.0]
    clip = lookup.copy()
    clip[2] = [0.0, 1.0 / 200.0, 0.0, 0.0]  # y down: the lower, the farther
    return clip, lookup


def window_of_spheres(
    clip: Matrix, centres: Matrix, *, radii_m: Matrix, size_wh: tuple[int, int]
) -> tuple[int, int, int, int] | None:
    """Pixel window [x0, x1) x [y0, y1) that holds all spheres drawn with ``clip``; None: all unseen."""
    seen = spheres_inside(clip, centres, radii_m)
    if not seen.any():
        return None
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    corners = (centres[:, None] + cube * radii_m[:, None, None]).reshape(-1, 3)
    in_clip = corners @ clip[:, :3].T + clip[:, 3]
    width, height = size_wh
    if (in_clip[:, 3] < NEAR_M).any():
        return 0, 0, width, height
    window = (in_clip[:, :2] / in_clip[:, 3:] + 1.0) / 2.0 * np.array([width, height])
    low = np.clip(np.floor(window.min(axis=0)).astype(int), 0, [width, height])
    high = np.clip(np.ceil(window.max(axis=0)).astype(int), 0, [width, height])
    if (high <= low).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
