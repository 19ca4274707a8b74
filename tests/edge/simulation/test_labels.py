"""Labels against what is drawn: boxes against identity pixels, truncation, occlusion, DontCare."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from edge.simulation.bodies.library import bodies
from edge.simulation.frames import assemble, camera_pose, moment_of_seed
from edge.simulation.labels import label_objects, outline
from edge.simulation.placing import PlacedObject
from edge.simulation.planting.planter import Surroundings
from edge.simulation.render.renderer import Renderer
from edge.simulation.rig import cameras, kitti_rig
from edge.simulation.scene import Light
from runtime.contracts.errors import MissingExtraError
from runtime.contracts.geometry import project_to_image
from runtime.contracts.objects import Objects3D, box_corners

RIG = kitti_rig()
EYE = camera_pose(0.0, -1.65, 0.0, heading_rad=0.0)
PIXEL_TOLERANCE = 1.0  # an outline ends anywhere within a pixel; thin mirrors and tyres can miss pixel centres
TEXT_TOLERANCE = 1e-6
SEEN = {1: (1000, 1000)}


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    try:
        opened = Renderer(RIG.image_size_wh)
    except MissingExtraError as error:
        pytest.skip(str(error))
    with opened:
        yield opened


def _car(
    x: float, z: float, *, yaw: float = -1.2, object_id: int = 1, kind: str = "Car", index: int = 3
) -> PlacedObject:
    body = bodies(kind)[index]
    size = tuple(float(value) for value in body.size_hwl[0])
    return PlacedObject(kind, body, 0, size, (x, 0.0, z), yaw, (0.5, 0.5, 0.5), object_id, size)  # type: ignore[arg-type]


def _label(*objects: PlacedObject, pixels: dict[int, tuple[int, int]] | None = None) -> Objects3D:
    counted = pixels or {item.object_id: (1000, 1000) for item in objects}
    return label_objects(objects, geometry=RIG, camera_from_world=EYE, pixels=counted)


def test_no_objects_no_labels() -> None:
    labels = _label()
    assert len(labels) == 0 and len(labels.dont_care_boxes) == 0


def test_what_lies_behind_has_no_outline() -> None:
    mesh = bodies("Car")[0].phases[0]
    assert outline(RIG, mesh.positions - np.array([0.0, 0.0, 20.0]), mesh.triangles) is None


def test_label_numbers_of_one_car() -> None:
    car = _car(3.0, 15.0, yaw=0.4)
    labels = _label(car)
    assert labels.center_in_camera[0] == pytest.approx([3.0, 1.65 - 0.5 * car.size_hwl[0], 15.0])
    assert labels.yaw_rad[0] == pytest.approx(0.4)
    assert labels.alpha_rad[0] == pytest.approx(0.4 - np.arctan2(3.0, 15.0))
    assert labels.size_hwl[0] == pytest.approx(car.size_hwl)
    assert labels.truncation[0] == 0.0 and labels.occlusion[0] == 0 and labels.track_id[0] == 0


def test_turned_camera_turns_yaw_and_place() -> None:
    heading = 0.3
    pose = camera_pose(2.0, -1.65, 5.0, heading_rad=heading)
    car = _car(2.0 + 20.0 * np.sin(heading), 5.0 + 20.0 * np.cos(heading), yaw=heading - 0.5 * np.pi)
    labels = label_objects([car], geometry=RIG, camera_from_world=pose, pixels=SEEN)
    assert labels.center_in_camera[0][[0, 2]] == pytest.approx([0.0, 20.0])
    assert labels.yaw_rad[0] == pytest.approx(-0.5 * np.pi), "it drives along the view"


def test_the_mesh_lies_in_its_box_and_touches_all_sides() -> None:
    car = _car(-4.0, 14.0, yaw=2.0)
    labels = _label(car)
    corners = box_corners(labels.center_in_camera, labels.size_hwl, labels.yaw_rad)[0]
    matrix = EYE @ car.world_from_model()
    vertices = car.body.phases[0].positions @ matrix[:3, :3].T + matrix[:3, 3]
    local = (vertices - labels.center_in_camera[0]) @ np.linalg.inv(_turn(2.0)).T
    assert np.abs(local).max(axis=0) == pytest.approx(0.5 * labels.size_hwl[0][[2, 0, 1]], abs=1e-4)
    pixels, _ = project_to_image(RIG.P2, corners)
    box = labels.box_in_left_image[0]
    assert (pixels.min(axis=0) <= box[:2] + 0.01).all() and (pixels.max(axis=0) >= box[2:] - 0.01).all()


def _turn(yaw: float) -> np.ndarray:
    cos, sin = np.cos(yaw), np.sin(yaw)
    return np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])


@pytest.mark.parametrize(
    ("seen", "level"),
    [((100, 100), 0), ((80, 100), 0), ((79, 100), 1), ((40, 100), 1), ((39, 100), 2), ((10, 100), 2), ((9, 100), None)],
)
def test_occlusion_levels(seen: tuple[int, int], level: int | None) -> None:
    labels = _label(_car(0.0, 20.0), pixels={1: seen})
    if level is None:
        assert len(labels) == 0 and len(labels.dont_care_boxes) == 1
    else:
        assert labels.occlusion.tolist() == [level] and len(labels.dont_care_boxes) == 0


def test_dont_care_only_for_small_hidden_cut_or_far() -> None:
    assert len(_label(_car(0.0, 89.0, kind="Truck")).dont_care_boxes) == 0
    assert len(_label(_car(0.0, 91.0, kind="Truck")).dont_care_boxes) == 1, "beyond 90 m"
    assert len(_label(_car(0.0, 85.0)).dont_care_boxes) == 1, "under 16 px"
    assert len(_label(_car(4.6, 3.2, yaw=-1.57)).dont_care_boxes) == 1, "over nine tenths beyond the edge"
    hidden = _label(_car(0.0, 20.0), pixels={1: (0, 500)})
    assert len(hidden) == 0 and len(hidden.dont_care_boxes) == 0, "nothing to be seen, nothing to write"


def test_truncation_is_the_share_of_the_uncut_box() -> None:
    car = _car(-8.6, 10.0, yaw=0.0)
    labels = _label(car)
    matrix = EYE @ car.world_from_model()
    vertices = car.body.phases[0].positions @ matrix[:3, :3].T + matrix[:3, 3]
    pixels, _ = project_to_image(RIG.P2, vertices.astype(np.float64))
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    box = labels.box_in_left_image[0]
    assert low[0] < 0 < high[0]
    expected = 1.0 - np.prod(box[2:] - box[:2]) / np.prod(high - low)
    assert 0.2 < expected < 0.9
    assert labels.truncation[0] == pytest.approx(expected, abs=TEXT_TOLERANCE)


def test_an_object_across_the_image_plane_is_cut_not_mirrored() -> None:
    labels = _label(_car(-2.6, 2.0, yaw=-1.5708))
    assert len(labels) + len(labels.dont_care_boxes) == 1
    box = labels.box_in_left_image[0] if len(labels) else labels.dont_care_boxes[0]
    assert box[0] == 0.0 and box[2] < RIG.image_size_wh[0] / 2, "left of the middle"


def test_boxes_are_tight_round_the_drawn_pixels(renderer: Renderer) -> None:
    objects = (
        _car(-3.0, 12.0), _car(4.0, 18.0, yaw=0.3, object_id=2), _car(0.5, 40.0, yaw=1.5, object_id=3),
        _car(2.4, 9.0, object_id=4, kind="Pedestrian"), _car(-9.5, 11.0, object_id=5, kind="Van", yaw=0.2),
        _car(-6.0, 25.0, object_id=6, kind="Cyclist", yaw=0.1),
    )  # fmt: skip
    left, _ = cameras(RIG, EYE)
    for item in objects:
        alone = (replace(item, object_id=1),)
        scene = assemble(Surroundings(), alone, Light(np.array([0.3, -0.9, 0.3])), 0)
        drawn = renderer.render(scene, left).object_id == 1
        rows, columns = np.flatnonzero(drawn.any(axis=1)), np.flatnonzero(drawn.any(axis=0))
        painted = np.array([columns[0], rows[0], columns[-1], rows[-1]], dtype=np.float64)
        labels = _label(*alone)
        assert labels.box_in_left_image[0] == pytest.approx(painted, abs=PIXEL_TOLERANCE + 0.5), item.kind


def test_occlusion_of_a_car_behind_a_van(renderer: Renderer) -> None:
    objects = (_car(0.0, 12.0, yaw=0.0, kind="Van"), _car(0.6, 20.0, yaw=0.0, object_id=2))
    scene = assemble(Surroundings(), objects, Light(np.array([0.3, -0.9, 0.3])), 0)
    left, _ = cameras(RIG, EYE)
    pixels = renderer.visible_and_total_pixels(scene, left, [1, 2])
    assert pixels[1][0] == pixels[1][1] > 0
    assert 0 <= pixels[2][0] < 0.4 * pixels[2][1]


def test_scenes_hold_what_layouts_say(renderer: Renderer) -> None:
    moment = moment_of_seed(40_007, RIG)
    labelled = {instance.object_id for instance in moment.scene.instances if instance.object_id}
    assert labelled == {item.object_id for item in moment.objects}
    assert all(instance.mesh in moment.scene.meshes for instance in moment.scene.instances)
