"""One simulated moment from its seed: world, scene, labels, pictures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.simulation.daylight import draw_light
from edge.simulation.drafts import AS_LABELLED, Mix
from edge.simulation.labels import label_objects
from edge.simulation.layout import Layout, lay_out
from edge.simulation.placing import PlacedObject
from edge.simulation.planting.planter import Surroundings
from edge.simulation.render.renderer import Renderer
from edge.simulation.rig import cameras
from edge.simulation.scene import Instance, Light, Mesh, Scene
from edge.simulation.sensor import StereoSensor, draw_sensor, expose, meter
from edge.simulation.surroundings import build_surroundings
from edge.simulation.wardrobe import dress
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Objects3D

FloatArray = NDArray[np.float64]
FRAME_SPAN_S_M = (-8.0, 110.0)


@dataclass(frozen=True, slots=True)
class Moment:
    """A scene with the objects in it and the reference camera's pose."""

    scene: Scene
    objects: tuple[PlacedObject, ...]
    camera_from_world: FloatArray


@dataclass(frozen=True, slots=True)
class SimulatedFrame:
    """A labelled pair: left and right (H, W, 3) uint8 BGR."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    labels: Objects3D


def camera_pose(x_m: float, y_m: float, z_m: float, *, heading_rad: float) -> FloatArray:
    """``camera_from_world`` (4, 4) of an upright camera at a world point; the heading turns from +z towards +x."""
    cos, sin = np.cos(heading_rad), np.sin(heading_rad)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    pose[:3, 3] = -pose[:3, :3] @ np.array([x_m, y_m, z_m])
    return pose


def assemble(surroundings: Surroundings, objects: tuple[PlacedObject, ...], light: Light, seed: int) -> Scene:
    """Scenery and objects as one scene."""
    meshes: dict[str, Mesh] = dict(surroundings.meshes)
    instances: list[Instance] = list(surroundings.instances)
    for item in objects:
        meshes[item.body.mesh_name(item.phase)] = item.body.phases[item.phase]
        instances.append(item.instance())
    return Scene(meshes, tuple(instances), light, seed)


def moment_of_seed(seed: int, geometry: StereoGeometry, mix: Mix = AS_LABELLED) -> Moment:
    """The world of a single frame."""
    layout: Layout = lay_out(seed, intrinsics=np.array(geometry.P2[:, :3]), size_wh=geometry.image_size_wh, mix=mix)
    rng = np.random.default_rng([seed, 2])
    surroundings = build_surroundings(
        layout.road,
        layout.street,
        rng,
        objects=layout.objects,
        screens=layout.screens,
        span_s_m=FRAME_SPAN_S_M,
        guard_views=True,
    )
    objects = dress(layout.objects, np.random.default_rng([seed, 4]))
    scene = assemble(surroundings, objects, draw_light(rng), seed % 100_003)
    return Moment(scene, objects, camera_pose(0.0, -layout.camera_height_m, 0.0, heading_rad=0.0))


def labels_of_seed(
    seed: int, geometry: StereoGeometry, renderer: Renderer, *, counting_size_wh: tuple[int, int]
) -> Objects3D:
    """The labels of a seed without its pictures.

    Args:
        seed: the frame's seed.
        geometry: the rig.
        renderer: counts visible pixels; opened with ``counting_size_wh``.
        counting_size_wh: size at which they are counted. A fraction of the rig's is quicker, and changes an occlusion
            level only where the visible share lies within rounding of a threshold.
    """
    moment = moment_of_seed(seed, geometry)
    width, height = counting_size_wh
    full_width, full_height = geometry.image_size_wh
    counted = geometry.scale((width / full_width, height / full_height), (width, height))
    left_camera, _ = cameras(counted, moment.camera_from_world)
    ids = [item.object_id for item in moment.objects]
    pixels = renderer.visible_and_total_pixels(moment.scene, left_camera, ids)
    return label_objects(moment.objects, geometry=geometry, camera_from_world=moment.camera_from_world, pixels=pixels)


def take(
    moment: Moment, geometry: StereoGeometry, renderer: Renderer, *, sensor: StereoSensor, rng: np.random.Generator
) -> SimulatedFrame:
    """Render and expose both views and label the moment."""
    left_camera, right_camera = cameras(geometry, moment.camera_from_world)
    left, right = renderer.render_pair(moment.scene, left_camera, right_camera)
    ids = [item.object_id for item in moment.objects]
    pixels = renderer.visible_and_total_pixels(moment.scene, left_camera, ids)
    labels = label_objects(moment.objects, geometry=geometry, camera_from_world=moment.camera_from_world, pixels=pixels)
    gain = meter(left.radiance, sensor.left)
    seen_right = sensor.error.apply(right.radiance)
    return SimulatedFrame(
        expose(left.radiance, sensor.left, rng, gain=gain), expose(seen_right, sensor.right, rng, gain=gain), labels
    )


def frame_of_seed(seed: int, geometry: StereoGeometry, renderer: Renderer, mix: Mix = AS_LABELLED) -> SimulatedFrame:
    """The labelled pair of a seed."""
    moment = moment_of_seed(seed, geometry, mix)
    rng = np.random.default_rng([seed, 3])
    return take(moment, geometry, renderer, sensor=draw_sensor(rng), rng=rng)
