"""The renderer against geometry: what is drawn where, how far, how much of it, and that it is the same again."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.simulation.render.geometry import KEPT_UNUSED_FRAMES
from edge.simulation.render.renderer import Renderer
from edge.simulation.scene import Instance, Light, Material, Mesh, PinholeCamera, RenderedView, Scene
from runtime.contracts.errors import FrameError, MissingExtraError

WIDTH, HEIGHT = 160, 96
FOCAL_PX = 120.0
CX, CY = 77.3, 45.8  # off the middle on purpose
CAMERA_HEIGHT_M = 1.65
BASELINE_M = 0.5
DEPTH_TOLERANCE = 1e-4  # relative; depth passes through float32 clip coordinates
STEREO_TOLERANCE = 0.06  # relative; haze, gloss and detail level follow the eye, which moves between the views
SAMPLING_TOLERANCE = 0.01  # relative; a pixel's samples lie within half a pixel of its centre


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    try:
        opened = Renderer((WIDTH, HEIGHT))
    except MissingExtraError as error:
        pytest.skip(str(error))
    with opened:
        yield opened


def _camera(x: float = 0.0, z: float = 0.0) -> PinholeCamera:
    intrinsics = np.array([[FOCAL_PX, 0.0, CX], [0.0, FOCAL_PX, CY], [0.0, 0.0, 1.0]])
    camera_from_world = np.eye(4)
    camera_from_world[:3, 3] = [-x, CAMERA_HEIGHT_M, -z]
    return PinholeCamera(intrinsics, camera_from_world, (WIDTH, HEIGHT))


def _light(**changes: object) -> Light:
    towards_sun = np.array([0.3, -0.9, -0.3])
    return dataclasses.replace(Light(towards_sun / np.linalg.norm(towards_sun), cloud_cover=0.1), **changes)


def _mesh(corners: list[list[list[float]]], material: Material) -> Mesh:
    """Quads of one material; each is four corners in order."""
    positions = np.array(corners, np.float32)
    edges = positions[:, 1] - positions[:, 0], positions[:, 3] - positions[:, 0]
    normals = np.cross(*edges)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(positions)
    triangles = (np.arange(count)[:, None, None] * 4 + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return Mesh(
        positions=positions.reshape(-1, 3),
        normals=np.repeat(normals, 4, axis=0).astype(np.float32),
        colours=np.full((count * 4, 3), 0.3, np.float32),
        materials=np.full(count * 4, int(material), np.uint8),
        triangles=triangles.astype(np.int32),
    )


def _box(size_lhw: tuple[float, float, float], material: Material = Material.MATTE) -> Mesh:
    """A box standing on its model frame's origin: length along x, width along z."""
    x, y, z = size_lhw[0] / 2, -size_lhw[1], size_lhw[2] / 2
    return _mesh(
        [
            [[-x, 0, -z], [-x, y, -z], [x, y, -z], [x, 0, -z]],
            [[-x, 0, z], [x, 0, z], [x, y, z], [-x, y, z]],
            [[-x, 0, -z], [-x, 0, z], [-x, y, z], [-x, y, -z]],
            [[x, 0, -z], [x, y, -z], [x, y, z], [x, 0, z]],
            [[-x, y, -z], [-x, y, z], [x, y, z], [x, y, -z]],
        ],
        material,
    )


def _ground(material: Material = Material.ASPHALT) -> Mesh:
    return _mesh([[[-40, 0, -5], [-40, 0, 80], [40, 0, 80], [40, 0, -5]]], material)


def _at(x: float, y: float, z: float) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, 3] = [x, y, z]
    return matrix


def _scene(meshes: dict[str, Mesh], *instances: Instance, **light: object) -> Scene:
    return Scene(meshes, instances, _light(**light))


def _box_before_ground(x: float, z: float) -> Scene:
    return _scene(
        {"box": _box((2.0, 1.5, 1.0)), "ground": _ground()},
        Instance("ground", np.eye(4)),
        Instance("box", _at(x, 0.0, z + 0.5), object_id=7),
    )


def _rectangle(x0: float, x1: float, y0: float, y1: float, z: float) -> NDArray[np.bool_]:
    """Pixels whose centres lie in the projection of a rectangle of points that faces the camera."""
    u = (np.arange(WIDTH) - CX) * z / FOCAL_PX
    v = (np.arange(HEIGHT) - CY) * z / FOCAL_PX - CAMERA_HEIGHT_M
    return ((v > y0) & (v < y1))[:, None] & ((u > x0) & (u < x1))[None, :]


def test_an_empty_scene_is_all_sky(renderer: Renderer) -> None:
    view = renderer.render(_scene({}), _camera())
    assert view.radiance.shape == (HEIGHT, WIDTH, 3) and view.radiance.dtype == np.float32
    assert view.object_id.shape == view.depth_m.shape == (HEIGHT, WIDTH)
    assert not view.object_id.any()
    assert np.isinf(view.depth_m).all()
    assert np.isfinite(view.radiance).all() and view.radiance.min() > 0.0


def test_a_mesh_without_triangles_draws_nothing(renderer: Renderer) -> None:
    empty = np.zeros((0, 3), np.float32)
    mesh = Mesh(empty, empty, empty, np.zeros(0, np.uint8), np.zeros((0, 3), np.int32))
    view = renderer.render(_scene({"none": mesh}, Instance("none", np.eye(4), object_id=1)), _camera())
    assert not view.object_id.any()


def test_a_camera_of_another_size_is_refused(renderer: Renderer) -> None:
    camera = dataclasses.replace(_camera(), size_wh=(WIDTH + 1, HEIGHT))
    with pytest.raises(FrameError, match="161x96"):
        renderer.render(_scene({}), camera)


@pytest.mark.parametrize(("x", "z"), [(0.0, 6.0), (-2.13, 9.3), (4.4, 8.0)])  # inside; left; cut by the border
def test_ids_fill_exactly_the_projected_front(renderer: Renderer, x: float, z: float) -> None:
    view = renderer.render(_box_before_ground(x, z), _camera())
    front = _rectangle(x - 1.0, x + 1.0, -1.5, 0.0, z)
    on_front = np.abs(view.depth_m - z) < DEPTH_TOLERANCE * z
    assert front.any()
    np.testing.assert_array_equal(on_front & (view.object_id == 7), front)


def test_depth_is_that_of_the_ground_plane(renderer: Renderer) -> None:
    scene = _scene({"ground": _ground()}, Instance("ground", np.eye(4)))
    depth = renderer.render(scene, _camera()).depth_m
    rows = np.arange(int(CY) + 4, HEIGHT)
    expected = FOCAL_PX * CAMERA_HEIGHT_M / (rows - CY)
    seen = depth[rows, WIDTH // 2]
    np.testing.assert_allclose(seen, expected, rtol=DEPTH_TOLERANCE)
    assert np.isinf(depth[: int(CY)]).all()


@pytest.mark.parametrize("material", [Material.CONCRETE, Material.FACADE, Material.BARK, Material.GRASS])
def test_the_right_view_is_the_left_one_shifted(renderer: Renderer, material: Material) -> None:
    depth_m, disparity_px = FOCAL_PX * BASELINE_M / 8.0, 8
    wall = _mesh([[[-20, 5, 0], [-20, -9, 0], [20, -9, 0], [20, 5, 0]]], material)
    scene = _scene({"wall": wall}, Instance("wall", _at(0, 0, depth_m), texture_seed=3.7), haze_per_m=0.0)
    left, right = renderer.render_pair(scene, _camera(), _camera(x=BASELINE_M))
    shifted = left.radiance[:, disparity_px:]
    contrast = shifted.std()
    matched = np.abs(shifted - right.radiance[:, :-disparity_px]).mean()
    unmatched = np.abs(shifted - right.radiance[:, disparity_px:]).mean()
    assert contrast > 0.02 * shifted.mean(), "a wall without texture cannot be matched"
    assert matched < STEREO_TOLERANCE * unmatched


def test_the_same_scene_gives_the_same_bytes(renderer: Renderer) -> None:
    scene = _box_before_ground(0.4, 7.0)
    first = renderer.render_pair(scene, _camera(), _camera(x=BASELINE_M))
    renderer.render(_scene({"ground": _ground()}, Instance("ground", np.eye(4))), _camera())
    _assert_same(first, renderer.render_pair(scene, _camera(), _camera(x=BASELINE_M)))
    with Renderer((WIDTH, HEIGHT)) as another:
        _assert_same(first, another.render_pair(scene, _camera(), _camera(x=BASELINE_M)))


def _assert_same(ours: tuple[RenderedView, ...], theirs: tuple[RenderedView, ...]) -> None:
    for a, b in zip(ours, theirs, strict=True):
        assert a.radiance.tobytes() == b.radiance.tobytes()
        assert a.object_id.tobytes() == b.object_id.tobytes()
        assert a.depth_m.tobytes() == b.depth_m.tobytes()


def test_colour_samples_soften_edges_and_move_nothing(renderer: Renderer) -> None:
    scene, camera = _box_before_ground(0.37, 7.0), _camera()
    views = []
    for samples in (1, 2, 4):
        with Renderer((WIDTH, HEIGHT), colour_samples=samples) as sampled:
            views.append(sampled.render(scene, camera))
    assert (views[0].object_id == 7).any()
    for view in views[1:]:
        assert view.object_id.tobytes() == views[0].object_id.tobytes()
        assert view.depth_m.tobytes() == views[0].depth_m.tobytes()
        assert (view.radiance != views[0].radiance).any()
        # the brightness of the picture as a whole stays: samples lie evenly around the pixel centre
        np.testing.assert_allclose(view.radiance.mean(), views[0].radiance.mean(), rtol=SAMPLING_TOLERANCE)


def test_far_from_the_worlds_origin_nothing_moves(renderer: Renderer) -> None:
    near = renderer.render(_box_before_ground(0.4, 7.0), _camera())
    scene = _box_before_ground(0.4, 7.0)
    far_away = 8192.0
    moved = [
        dataclasses.replace(item, world_from_model=_at(0, 0, far_away) @ item.world_from_model)
        for item in scene.instances
    ]
    far = renderer.render(dataclasses.replace(scene, instances=tuple(moved)), _camera(z=far_away))
    assert (near.object_id == 7).any()
    np.testing.assert_array_equal(near.object_id, far.object_id)
    np.testing.assert_allclose(near.depth_m, far.depth_m, rtol=DEPTH_TOLERANCE)


def test_visible_and_total_of_a_half_hidden_box(renderer: Renderer) -> None:
    wall = _mesh([[[0, 1, 0], [0, -4, 0], [9, -4, 0], [9, 1, 0]]], Material.CONCRETE)
    scene = _scene(
        {"box": _box((2.0, 1.5, 0.02)), "wall": wall},
        Instance("box", _at(0.0, 0.0, 9.01), object_id=3),
        Instance("box", _at(30.0, 0.0, 9.01), object_id=4),  # outside the picture
        Instance("wall", _at(0.2, 0.0, 5.0)),
    )
    counts = renderer.visible_and_total_pixels(scene, _camera(), [3, 4, 5])
    total = _rectangle(-1.0, 1.0, -1.5, 0.0, 9.0)
    hidden = _rectangle(0.2, 9.2, -4.0, 1.0, 5.0)
    assert counts == {3: (int((total & ~hidden).sum()), int(total.sum())), 4: (0, 0), 5: (0, 0)}
    view = renderer.render(scene, _camera())
    assert int((view.object_id == 3).sum()) == counts[3][0]


def test_parts_that_share_an_id_count_once(renderer: Renderer) -> None:
    scene = _scene(
        {"box": _box((2.0, 1.5, 0.02))},
        Instance("box", _at(-0.5, 0.0, 9.01), object_id=3),
        Instance("box", _at(0.5, 0.0, 9.01), object_id=3),
    )
    expected = int(_rectangle(-1.5, 1.5, -1.5, 0.0, 9.0).sum())
    camera = _camera()
    renderer.render(scene, camera)
    assert renderer.visible_and_total_pixels(scene, camera, [3]) == {3: (expected, expected)}


def test_counting_after_drawing_equals_counting_alone(renderer: Renderer) -> None:
    scene, camera = _box_before_ground(0.4, 7.0), _camera()
    alone = renderer.visible_and_total_pixels(scene, camera, [7])
    renderer.render_pair(scene, camera, _camera(x=BASELINE_M))
    assert renderer.visible_and_total_pixels(scene, camera, [7]) == alone


def test_the_suns_shadow_darkens_the_ground(renderer: Renderer) -> None:
    roof = _mesh([[[-3, 0, -3], [-3, 0, 3], [3, 0, 3], [3, 0, -3]]], Material.MATTE)
    towards_sun = np.array([0.0, -1.0, 0.0])

    def ground_brightness(roof_height_m: float) -> float:
        scene = _scene(
            {"ground": _ground(), "roof": roof},
            Instance("ground", np.eye(4)),
            Instance("roof", _at(0.0, -roof_height_m, 9.0)),
            towards_sun=towards_sun,
        )
        view = renderer.render(scene, _camera())
        row = round(CY + FOCAL_PX * CAMERA_HEIGHT_M / 9.0)
        return float(view.radiance[row - 1 : row + 2, WIDTH // 2 - 4 : WIDTH // 2 + 4].mean())

    under_roof, under_ground = ground_brightness(8.0), ground_brightness(-8.0)
    assert under_roof < 0.5 * under_ground


def test_cloud_weakens_the_sun(renderer: Renderer) -> None:
    meshes, ground = {"ground": _ground()}, Instance("ground", np.eye(4))
    clear = renderer.render(_scene(meshes, ground, cloud_cover=0.0), _camera()).radiance[-10:].mean()
    overcast = renderer.render(_scene(meshes, ground, cloud_cover=1.0), _camera()).radiance[-10:].mean()
    assert overcast < 0.6 * clear


def test_tint_colours_paint_and_nothing_else(renderer: Renderer) -> None:
    def red_share(material: Material) -> float:
        scene = _scene(
            {"box": _box((3.0, 2.0, 1.0), material)},
            Instance("box", _at(0.0, 0.0, 6.0), tint=(1.0, 0.05, 0.05), object_id=1),
        )
        view = renderer.render(scene, _camera())
        mean = view.radiance[view.object_id == 1].mean(axis=0)
        return float(mean[0] / mean.sum())

    assert red_share(Material.CAR_PAINT) > 0.5
    assert red_share(Material.CLOTH) > 0.5
    assert red_share(Material.MATTE) < 0.4


@pytest.mark.parametrize("material", list(Material))
def test_every_material_gives_finite_light(renderer: Renderer, material: Material) -> None:
    scene = _scene(
        {"box": _box((3.0, 2.0, 1.0), material)},
        Instance("box", _at(0.0, 0.0, 6.0), object_id=1, texture_seed=12.3),
    )
    view = renderer.render(scene, _camera())
    inside = view.radiance[view.object_id == 1]
    assert len(inside) > 100
    assert np.isfinite(inside).all() and inside.min() >= 0.0
    assert inside.std() > 0.0


def test_meshes_that_are_no_longer_used_are_let_go(renderer: Renderer) -> None:
    renderer.render(_box_before_ground(0.0, 6.0), _camera())
    held = renderer.uploaded_mesh_count
    for _ in range(KEPT_UNUSED_FRAMES + 1):
        renderer.render(_scene({}), _camera())
    assert held >= 2
    assert renderer.uploaded_mesh_count == 0


def test_without_moderngl_the_line_to_install_it_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "moderngl", None)
    with pytest.raises(MissingExtraError, match=r"pip install \.\[simulate\]"):
        Renderer((WIDTH, HEIGHT))


def test_without_egl_the_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    moderngl = pytest.importorskip("moderngl")

    def refuse(**_: object) -> None:
        raise ImportError("libEGL.so not loaded\n")

    monkeypatch.setattr(moderngl, "create_context", refuse)
    with pytest.raises(MissingExtraError, match="libegl1 libgl1 libgl1-mesa-dri") as caught:
        Renderer((WIDTH, HEIGHT))
    assert "\n" not in str(caught.value)
