"""Draws scenes: shadow and cover maps, then identity (exact) and colour (antialiased) for each camera."""

from __future__ import annotations

from types import TracebackType
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from edge.simulation.render import projection
from edge.simulation.render.context import open_context
from edge.simulation.render.geometry import GeometryCache, InstanceDrawer, PlacedMesh, spans_of
from edge.simulation.render.programs import (
    COVER_UNIT,
    GROUP_NAMES,
    HOLED_GROUP,
    NOISE_UNIT,
    SHADOW_UNIT,
    Programs,
    group_of_material,
    set_uniforms,
)
from edge.simulation.render.targets import SHADOW_TEXELS, Targets
from edge.simulation.scene import BACKGROUND_ID, Light, PinholeCamera, RenderedView, Scene
from runtime.contracts.errors import FrameError

COVER_LIMIT_M = 2.2  # what stands higher shades the ground no more than this would
# Colour is drawn once for each sample, the picture shifted by so many pixels, and averaged. On a CPU two whole
# drawings cost half of what 4-sample multisampling does. A sample keeps leaves that cover at least the share.
_COLOUR_SAMPLES = {
    1: (((0.0, 0.0), 0.5),),
    2: (((0.25, -0.25), 0.25), ((-0.25, 0.25), 0.75)),
    4: (
        ((0.125, 0.375), 0.125),
        ((-0.125, -0.375), 0.375),
        ((0.375, -0.125), 0.625),
        ((-0.375, 0.125), 0.875),
    ),
}
_OVERCAST_SUN_SHARE = 0.06
_AIR_SHARE = 0.8  # of the horizon's radiance, in haze
_DOME_SHARE = 0.75  # streets see less than the whole sky
_GROUND_ALBEDO = 0.08
_LUMINANCE = np.array([0.25, 0.6, 0.15])


class Renderer:
    """Holds an OpenGL context and what was uploaded to it; use as a context manager, from one thread.

    Several renderers may be open at once: each call makes its own context current while it runs.
    """

    def __init__(self, size_wh: tuple[int, int], *, colour_samples: Literal[1, 2, 4] = 2) -> None:
        """Open the context.

        Args:
            size_wh: picture size in pixels; every camera drawn must have it.
            colour_samples: colours averaged a pixel; 1 is fast and jagged, 4 smooth. Ids and depth are always
                taken at the pixel centre.

        Raises:
            MissingExtraError: no moderngl or no EGL; the message says what to install.
        """
        self._size_wh = size_wh
        self._samples = _COLOUR_SAMPLES[colour_samples]
        self._context = open_context()
        self._programs = Programs(self._context)
        self._targets = Targets(self._context, size_wh)
        self._cache = GeometryCache(self._context, group_of_material=group_of_material(), group_names=GROUP_NAMES)
        self._drawer = InstanceDrawer(self._context, holed_group=HOLED_GROUP)
        corners = np.array([[-1, -1], [3, -1], [-1, 3]], np.float32)
        self._sky_corners = self._context.buffer(corners.tobytes())
        self._sky = self._context.vertex_array(self._programs["sky"], [(self._sky_corners, "2f4", "in_corner")])
        self._last_identity: tuple[Scene, PinholeCamera, NDArray[np.int32]] | None = None

    def __enter__(self) -> Renderer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Free everything; the renderer cannot be used afterwards."""
        with self._context:
            self._cache.release()
            self._sky.release()
            self._sky_corners.release()
            self._targets.release()
            self._programs.release()
        self._context.release()

    @property
    def uploaded_mesh_count(self) -> int:
        """How many meshes are held in GPU memory at present."""
        return len(self._cache)

    def render(self, scene: Scene, camera: PinholeCamera) -> RenderedView:
        """Draw one view.

        Raises:
            FrameError: the camera's size is not the renderer's.
        """
        with self._context:
            return self._render_views(scene, (camera,))[0]

    def render_pair(
        self, scene: Scene, left_camera: PinholeCamera, right_camera: PinholeCamera
    ) -> tuple[RenderedView, RenderedView]:
        """Draw both views of a stereo pair, sharing geometry, shadow and cover maps.

        Raises:
            FrameError: a camera's size is not the renderer's.
        """
        with self._context:
            left, right = self._render_views(scene, (left_camera, right_camera))
        return left, right

    def visible_and_total_pixels(
        self, scene: Scene, camera: PinholeCamera, object_ids: tuple[int, ...] | list[int]
    ) -> dict[int, tuple[int, int]]:
        """How many pixels of each object are seen, and how many would be if nothing stood before it.

        Both count pixel centres inside the picture. Right after `render` or `render_pair` of the same scene
        object with the same left camera object, the identity buffer of that call is used again.

        Args:
            object_ids: ids to count; BACKGROUND_ID is not an object.

        Returns:
            Object id -> (visible, total).
        """
        self._check(camera)
        origin = projection.camera_position(camera)
        clip = projection.clip_from_world(camera, origin)
        with self._context:
            placed = self._cache.place(scene, origin)
            identity = self._identity_of(scene, camera, placed=placed, clip=clip)
            totals = self._totals(placed, clip, set(object_ids) - {BACKGROUND_ID})
        counts = np.bincount(identity.ravel(), minlength=max([0, *object_ids]) + 1)
        # drawn alone, a pixel on the outline may round the other way: never claim more seen than there is
        return {id_: (int(counts[id_]), max(totals.get(id_, 0), int(counts[id_]))) for id_ in object_ids}

    def _check(self, camera: PinholeCamera) -> None:
        if tuple(camera.size_wh) != tuple(self._size_wh):
            raise FrameError(
                f"found a camera of {camera.size_wh[0]}x{camera.size_wh[1]} px, this renderer draws "
                f"{self._size_wh[0]}x{self._size_wh[1]} px; open a Renderer of the camera's size"
            )

    def _render_views(self, scene: Scene, cameras: tuple[PinholeCamera, ...]) -> list[RenderedView]:
        for camera in cameras:
            self._check(camera)
        origin = projection.camera_position(cameras[0])
        placed = self._cache.place(scene, origin)
        self._set_light(scene)
        self._draw_shadow(scene.light, cameras[0], placed=placed, origin=origin)
        self._draw_cover(cameras[0], placed=placed, origin=origin)
        clips = [projection.clip_from_world(camera, origin) for camera in cameras]
        chosen = self._load_seen(placed, clips)
        views = []
        for camera, clip in zip(cameras, clips, strict=True):
            self._programs.set_all(
                u_eye=projection.camera_position(camera) - origin,
                u_metres_per_pixel_at_1m=float(1.0 / camera.intrinsics[0, 0]),
            )
            self._draw_identity(chosen, clip)
            object_id, depth_m = self._targets.read_identity()
            radiance = self._draw_colour(camera, chosen=chosen, origin=origin)
            views.append(RenderedView(radiance, object_id, depth_m))
        self._last_identity = (scene, cameras[0], views[0].object_id)
        return views

    def _set_light(self, scene: Scene) -> None:
        light = scene.light
        towards_sun = np.asarray(light.towards_sun, float) / np.linalg.norm(light.towards_sun)
        overcast = float(np.clip((light.cloud_cover - 0.35) / 0.65, 0.0, 1.0))
        share = (1.0 - overcast) ** 1.5 * (1.0 - _OVERCAST_SUN_SHARE) + _OVERCAST_SUN_SHARE
        share = share if towards_sun[1] < 0.0 else 0.0
        sun, zenith = np.array(light.sun_rgb), np.array(light.sky_zenith_rgb)
        horizon = np.array(light.sky_horizon_rgb)
        grey = (horizon @ _LUMINANCE) * np.array([0.85, 0.87, 0.9])
        dome = (0.45 * horizon + 0.55 * zenith) * (1.0 - overcast) + grey * overcast
        ground_light = sun * share * max(-towards_sun[1], 0.0) + dome
        rng = np.random.default_rng(scene.seed)
        self._programs.set_all(
            u_sun=towards_sun,
            u_sun_rgb=light.sun_rgb,
            u_zenith=light.sky_zenith_rgb,
            u_horizon=light.sky_horizon_rgb,
            u_cloud_cover=float(light.cloud_cover),
            u_haze_per_m=float(light.haze_per_m),
            u_exposure=float(light.exposure),
            u_sun_share=share,
            u_air=(horizon * (1.0 - overcast) + grey * overcast) * _AIR_SHARE,
            u_dome=dome * _DOME_SHARE,
            u_bounce=ground_light * _GROUND_ALBEDO,
            u_shadow_texel=1.0 / SHADOW_TEXELS,
            u_shadow_spread=0.8 + 3.0 * overcast,
            u_sky_shift=tuple(rng.uniform(0.0, 50.0, 2)),
        )
        self._programs.noise.use(NOISE_UNIT)
        self._targets.shadow_texture.use(SHADOW_UNIT)
        self._targets.cover_texture.use(COVER_UNIT)

    def _draw_shadow(
        self, light: Light, camera: PinholeCamera, *, placed: list[PlacedMesh], origin: NDArray[np.float64]
    ) -> None:
        clip = projection.shadow_clip_from_world(camera, light.towards_sun, origin=origin, texels=SHADOW_TEXELS)
        self._programs.set_all(u_shadow_from_world=clip)
        self._targets.shadow.use()
        self._targets.shadow.clear(depth=1.0)
        self._drawer.faces_out(clockwise=False)
        self._draw_geometry("shadow", self._load_seen(placed, [clip]), clip)

    def _draw_cover(self, camera: PinholeCamera, *, placed: list[PlacedMesh], origin: NDArray[np.float64]) -> None:
        clip, lookup = projection.cover_matrices(camera, origin)
        self._programs.set_all(u_cover_from_world=lookup, u_highest=float(origin[1] + COVER_LIMIT_M))
        self._targets.cover.use()
        self._targets.cover.clear(red=float(origin[1]), depth=1.0)
        self._drawer.faces_out(clockwise=False)
        self._draw_geometry("cover", self._load_seen(placed, [clip]), clip)
        self._targets.cover_texture.build_mipmaps()

    def _load_seen(self, placed: list[PlacedMesh], clips: list[NDArray[np.float64]]) -> list[tuple[PlacedMesh, int]]:
        """Load the instances that touch any of the volumes; nearest meshes first, nearest instances first."""
        kept: list[tuple[float, PlacedMesh, NDArray[np.int64]]] = []
        for item in placed:
            inside = np.zeros(len(item.centres), bool)
            for clip in clips:
                inside |= projection.spheres_inside(clip, item.centres, item.radii_m)
            index = np.flatnonzero(inside)
            if len(index):
                distance = np.linalg.norm(item.centres[index], axis=1)
                kept.append((float(distance.min()), item, index[np.argsort(distance, kind="stable")]))
        kept.sort(key=lambda entry: entry[0])
        for _, item, index in kept:
            self._drawer.load(item, index)
        return [(item, len(index)) for _, item, index in kept]

    def _draw_geometry(self, kind: str, chosen: list[tuple[PlacedMesh, int]], clip: NDArray[np.float64]) -> None:
        programs = {holed: f"{kind}/{'holed' if holed else 'solid'}" for holed in (False, True)}
        for name in programs.values():
            set_uniforms(self._programs[name], u_clip_from_world=clip)
        self._context.enable_only(self._context.DEPTH_TEST)
        for item, count in chosen:
            for holed, span in spans_of(item.uploaded, holed_group=HOLED_GROUP):
                name = programs[holed]
                self._drawer.draw(item, (name, self._programs[name]), span=span, count=count)

    def _draw_identity(self, chosen: list[tuple[PlacedMesh, int]], clip: NDArray[np.float64]) -> None:
        self._targets.identity.use()
        self._targets.identity.clear(depth=1.0)
        self._drawer.faces_out(clockwise=True)
        self._draw_geometry("identity", chosen, clip)

    def _draw_colour(
        self, camera: PinholeCamera, *, chosen: list[tuple[PlacedMesh, int]], origin: NDArray[np.float64]
    ) -> NDArray[np.float32]:
        total = np.zeros((self._size_wh[1], self._size_wh[0], 3), np.float32)
        self._targets.colour.use()
        self._context.enable_only(self._context.DEPTH_TEST)
        self._drawer.faces_out(clockwise=True)
        for shift_px, least_cover in self._samples:
            self._targets.colour.clear(depth=1.0)
            clip = projection.clip_from_world(camera, origin, shift_px=shift_px)
            self._programs.set_all(u_clip_from_world=clip, u_least_cover=least_cover)
            for item, count in chosen:
                for name, span in item.uploaded.ranges.items():
                    self._drawer.draw(item, (name, self._programs[name]), span=span, count=count)
            self._context.depth_func = "<="
            rays = projection.rays_from_clip(camera, shift_px=shift_px)
            set_uniforms(self._programs["sky"], u_rays_from_clip=rays)
            self._sky.render(vertices=3)
            self._context.depth_func = "<"
            total += self._targets.read_radiance()
        total *= np.float32(1.0 / len(self._samples))
        return total

    def _identity_of(
        self, scene: Scene, camera: PinholeCamera, *, placed: list[PlacedMesh], clip: NDArray[np.float64]
    ) -> NDArray[np.int32]:
        if self._last_identity is not None:
            last_scene, last_camera, identity = self._last_identity
            if last_scene is scene and last_camera is camera:
                return identity
        self._programs.set_all(u_eye=np.zeros(3), u_metres_per_pixel_at_1m=float(1.0 / camera.intrinsics[0, 0]))
        self._programs.noise.use(NOISE_UNIT)
        self._draw_identity(self._load_seen(placed, [clip]), clip)
        identity, _ = self._targets.read_identity()
        self._last_identity = (scene, camera, identity)
        return identity

    def _totals(self, placed: list[PlacedMesh], clip: NDArray[np.float64], object_ids: set[int]) -> dict[int, int]:
        """Draw each object alone into its own window of the identity buffer and count."""
        parts: dict[int, list[tuple[PlacedMesh, NDArray[np.int64]]]] = {}
        for item in placed:
            for id_ in object_ids.intersection(item.object_ids.tolist()):
                parts.setdefault(id_, []).append((item, np.flatnonzero(item.object_ids == id_)))
        totals: dict[int, int] = {}
        self._drawer.faces_out(clockwise=True)
        self._programs.noise.use(NOISE_UNIT)
        target = self._targets.identity
        for id_, instances in parts.items():
            centres = np.concatenate([item.centres[index] for item, index in instances])
            radii = np.concatenate([item.radii_m[index] for item, index in instances])
            window = projection.window_of_spheres(clip, centres, radii_m=radii, size_wh=self._size_wh)
            if window is None:
                totals[id_] = 0
                continue
            x0, y0, x1, y1 = window
            target.use()
            target.scissor = (x0, y0, x1 - x0, y1 - y0)
            target.clear(depth=1.0)
            chosen = []
            for item, index in instances:
                self._drawer.load(item, index)
                chosen.append((item, len(index)))
            self._draw_geometry("identity", chosen, clip)
            totals[id_] = int(np.count_nonzero(self._targets.read_identity_window(window) == id_))
        target.scissor = None
        return totals
