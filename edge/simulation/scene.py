"""What a simulated world hands to the renderer: meshes, instances, light, cameras.

World frame: metres, x right, y DOWN, z forward; the road surface lies near y = 0, so KITTI's camera is at y = -1.65.
Model frame of an object: origin at the bottom centre of its box, length along +x, width along z, up is -y; the same
frame as a KITTI label's box, so ``world = rotation_y(yaw) @ model + location`` with the label's own ``rotation_y``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

BACKGROUND_ID = 0


class Material(IntEnum):
    """Surface kinds; the shader adds texture and gloss by kind, the vertex colour gives the base tone."""

    MATTE = 0
    CAR_PAINT = 1
    GLASS = 2
    RUBBER = 3
    METAL = 4
    ASPHALT = 5
    MARKING = 6
    GRASS = 7
    FOLIAGE = 8
    BARK = 9
    FACADE = 10
    SKIN = 11
    CLOTH = 12
    LAMP = 13
    CONCRETE = 14
    SIGN = 15


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles in a model frame.

    Attributes:
        positions: (V, 3) float32, metres.
        normals: (V, 3) float32, unit length.
        colours: (V, 3) float32, linear RGB in [0, 1]; times the instance's tint on CAR_PAINT and CLOTH.
        materials: (V,) uint8, `Material` per vertex.
        triangles: (T, 3) int32 vertex indices.
    """

    positions: NDArray[np.float32]
    normals: NDArray[np.float32]
    colours: NDArray[np.float32]
    materials: NDArray[np.uint8]
    triangles: NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class Instance:
    """One placed mesh. ``object_id`` is BACKGROUND_ID for scenery, 1.. for a labelled object (parts may share one)."""

    mesh: str
    world_from_model: NDArray[np.float64]  # (4, 4)
    tint: tuple[float, float, float] = (1.0, 1.0, 1.0)
    object_id: int = BACKGROUND_ID
    texture_seed: float = 0.0  # varies procedural texture between instances of one mesh


@dataclass(frozen=True, slots=True)
class Light:
    """Sun, sky and air. Directions are unit vectors in the world frame; radiances are linear."""

    towards_sun: NDArray[np.float64]  # (3,), y negative when the sun is up
    sun_rgb: tuple[float, float, float] = (3.0, 2.8, 2.5)
    sky_zenith_rgb: tuple[float, float, float] = (0.25, 0.45, 0.85)
    sky_horizon_rgb: tuple[float, float, float] = (0.75, 0.82, 0.9)
    cloud_cover: float = 0.3  # 0 clear .. 1 overcast (soft, weak shadows)
    haze_per_m: float = 0.002
    exposure: float = 1.0


@dataclass(frozen=True, slots=True)
class Scene:
    """A frozen moment of the world."""

    meshes: dict[str, Mesh]
    instances: tuple[Instance, ...]
    light: Light
    seed: int = 0  # for procedural texture and sky


@dataclass(frozen=True, slots=True)
class PinholeCamera:
    """An ideal camera; ``camera_from_world`` maps world metres to x right, y down, z forward."""

    intrinsics: NDArray[np.float64]  # (3, 3)
    camera_from_world: NDArray[np.float64]  # (4, 4)
    size_wh: tuple[int, int]


@dataclass(frozen=True, slots=True)
class RenderedView:
    """One rendered image.

    Attributes:
        radiance: (H, W, 3) float32 linear RGB after exposure, before the sensor model.
        object_id: (H, W) int32, BACKGROUND_ID where no labelled object is in front.
        depth_m: (H, W) float32 z-depth in metres, inf for sky.
    """

    radiance: NDArray[np.float32]
    object_id: NDArray[np.int32]
    depth_m: NDArray[np.float32] = field(repr=False)
