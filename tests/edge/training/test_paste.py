"""Objects pasted between stereo pairs: true size, disparity, angle and occlusion; nothing in the air or in a wall."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest

pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.presets import preset
from edge.training import free_ground
from edge.training.frame_changes import FrameChanges, frame_changes
from edge.training.object_bank import ObjectBank, cut_out, plain_objects
from edge.training.object_masks import depth_along_rays, disparity_at
from edge.training.paste import ObjectPaster, paste_object, place_at
from edge.training.samples import SampleMaker
from edge.training.stream import MixedFrames
from runtime.contracts.errors import EdgeError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry, project_to_image
from runtime.contracts.objects import Objects3D, box_corners

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]

FOCAL_PX, BASELINE_M, HEIGHT_M, SIZE_WH = 700.0, 0.54, 1.65, (900, 300)
HORIZON = 120.0
DISPARITY_TOLERANCE_PX = 0.6  # block matching on a scaled, blended texture
EDGE_TOLERANCE_PX = 3.0  # soft edges; the mask follows the texture
RIM_TOLERANCE_PX = 2.5  # matching widens what is in front; gaps of a few pixels are closed
EXACT = 1e-9  # the same float64 arithmetic in another order
WALKER_HWL = (1.75, 0.7, 0.6)
PERSON = ((16, 44, 0, 120), (0, 60, 30, 65))  # columns and rows of a board of 60 x 120: a body with arms
PERSON_SHARE = (28 * 120 + 32 * 35) / (60 * 120)  # of the board


def geometry(focal_px: float = FOCAL_PX) -> StereoGeometry:
    left = np.array([[focal_px, 0, 450, 0.06 * focal_px], [0, focal_px, HORIZON, 0], [0, 0, 1, 0.0]])
    right = left.copy()
    right[0, 3] -= focal_px * BASELINE_M
    return StereoGeometry(left, right, SIZE_WH)


def labels(*rows: tuple[str, float, float]) -> Objects3D:
    """Objects of a class at x, z, standing on the ground and seen from behind, box of the projected corners."""
    if not rows:
        return Objects3D.empty(("Pedestrian",))
    names = tuple(dict.fromkeys(name for name, _, _ in rows))
    center = np.array([[x, HEIGHT_M - WALKER_HWL[0] / 2, z] for _, x, z in rows])
    size, yaw = np.tile(WALKER_HWL, (len(rows), 1)), np.full(len(rows), -1.57)
    pixels, _ = project_to_image(geometry().P2, box_corners(center, size, yaw))
    count = np.zeros(len(rows))
    return Objects3D(
        class_id=np.array([names.index(name) for name, _, _ in rows]),
        box_in_left_image=np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1),
        center_in_camera=center,
        size_hwl=size,
        alpha_rad=yaw - np.arctan2(center[:, 0], center[:, 2]),
        yaw_rad=yaw,
        truncation=count,
        occlusion=count,
        track_id=count - 1,
        dont_care_boxes=np.zeros((0, 4)),
        class_names=names,
    )


def scene(objects: Objects3D, *, seed: int = 0, wall_depth_m: float = 60.0) -> StereoFrame:
    """Textured ground up to a wall, and each object as a textured board at its depth; exact in both views."""
    rng = np.random.default_rng(seed)
    width, height = SIZE_WH
    rows = np.arange(height)
    ground_px = np.maximum(rows - HORIZON, 0) * BASELINE_M / HEIGHT_M
    texture = rng.normal(0, 1, (height, width + 200, 1)).astype(np.float32)
    texture = np.repeat(120 + 400 * cv2.GaussianBlur(texture, (0, 0), 3.0)[..., None], 3, axis=2)
    columns = np.arange(width, dtype=np.float32)
    disparity = np.maximum(ground_px, FOCAL_PX * BASELINE_M / wall_depth_m).astype(np.float32)
    y = np.repeat(rows[:, None], width, axis=1).astype(np.float32)
    left, right = (
        cv2.remap(texture, columns[None] + 100 + shift[:, None], y, cv2.INTER_LINEAR)
        for shift in (np.zeros(height, np.float32), disparity)
    )
    for row in np.argsort(-objects.center_in_camera[:, 2]):
        center, (h, w, _) = objects.center_in_camera[row], objects.size_hwl[row]
        spots = center + np.array([[-w / 2, -h / 2, 0], [w / 2, h / 2, 0]])
        board = 0.4 * rng.integers(0, 256, (120, 60, 3)).astype(np.float32) + np.array([0, 20, 140], np.float32)
        for image, P in ((left, geometry().P2), (right, geometry().P3)):
            (x1, y1), (x2, y2) = project_to_image(P, spots)[0]
            for first, last, top, bottom in PERSON:
                warp = np.array([[(x2 - x1) / 60, 0, x1], [0, (y2 - y1) / 120, y1]])
                warp[:, 2] += warp[:, 0] * first + warp[:, 1] * top
                piece = np.ascontiguousarray(board[top:bottom, first:last])
                cv2.warpAffine(piece, warp, SIZE_WH, dst=image, borderMode=cv2.BORDER_TRANSPARENT)
    images = [np.clip(image, 0, 255).astype(np.uint8) for image in (left, right)]
    return StereoFrame(images[0], images[1], 0.0, 0, f"{seed:06d}", geometry())


class Scenes:
    """As much of a `FrameSequence` as the bank and the stream ask for."""

    def __init__(self, *tables: Objects3D) -> None:
        self._tables = tables
        self._frames = [scene(objects, seed=index) for index, objects in enumerate(tables)]

    def __len__(self) -> int:
        return len(self._tables)

    def labels(self, index: int) -> Objects3D:
        return self._tables[index]

    def __getitem__(self, index: int) -> StereoFrame:
        return self._frames[index]


DONOR = labels(("Pedestrian", 1.0, 10.0))
FLAT = free_ground.Ground(HEIGHT_M, 0.0)


def test_no_object_nothing_to_cut() -> None:
    assert len(plain_objects(labels())) == 0
    bank = ObjectBank([Scenes(labels())], ("Pedestrian",))  # type: ignore[list-item]
    assert bank.classes == ()
    assert bank.draw("Pedestrian", np.random.default_rng(0)) is None
    with pytest.raises(EdgeError, match="finds no whole, near object"):
        frame_changes(preset("compact"), [Scenes(labels())], paste=0.3, method=None)  # type: ignore[list-item]


@pytest.mark.parametrize("name", ["paste", "zoom"])
def test_options_that_do_not_go_together(name: str) -> None:
    share = {name: 0.3}
    assert frame_changes(preset("mono"), [], method="paper") == FrameChanges()
    with pytest.raises(EdgeError, match="preset mono of one view"):
        frame_changes(preset("mono"), [], method=None, **share)  # type: ignore[arg-type]
    with pytest.raises(EdgeError, match="--method official"):
        frame_changes(preset("paper"), [], method="official", **share)  # type: ignore[arg-type]
    compact = preset("compact")
    points = replace(compact, training=replace(compact.training, disparity_source="points"))
    with pytest.raises(EdgeError, match="disparity from points"):
        frame_changes(points, [], method=None, **share)  # type: ignore[arg-type]


def test_objects_that_labels_call_hidden_are_not_cut() -> None:
    both = labels(("Pedestrian", 1.0, 10.0), ("Pedestrian", 1.1, 14.0), ("Pedestrian", -3.0, 12.0), ("Car", 3, 60.0))
    assert plain_objects(both).tolist() == [0, 2]
    assert plain_objects(replace(both, occlusion=np.array([0, 0, 1, 0]))).tolist() == [0]
    assert plain_objects(replace(both, truncation=np.array([0.1, 0, 0, 0]))).tolist() == [2]


def test_rays_meet_the_box_where_its_corners_are() -> None:
    center, P2 = DONOR.center_in_camera[0], geometry().P2
    (u, v), depth_m = project_to_image(P2, center)
    entry, exit_, below = depth_along_rays(P2, np.array([u, u + 400]), np.array([v]), objects=DONOR, row=0)
    assert entry[0, 0] < depth_m < exit_[0, 0]
    assert entry[0, 1] > exit_[0, 1]  # a ray far off
    assert exit_[0, 0] - entry[0, 0] == pytest.approx(WALKER_HWL[2] + 0.24, abs=0.05)
    assert not below[0, 0]


def test_disparity_counts_the_principal_columns() -> None:
    plain = geometry()
    P3 = plain.P3.copy()
    P3[0, 2] += 0.48
    shifted = StereoGeometry(plain.P2, P3, SIZE_WH)
    point = np.array([[1.0, 0.5, 20.0]])
    for rig in (plain, shifted):
        (left,), (right,) = (project_to_image(P, point)[0] for P in (rig.P2, rig.P3))
        assert disparity_at(rig, np.array(20.0)) == pytest.approx(left[0] - right[0], abs=EXACT)


def test_a_cut_holds_the_object_and_not_what_is_behind() -> None:
    frame = scene(DONOR)
    cut = cut_out(frame.left, frame.right, geometry=frame.geometry, objects=DONOR, row=0)  # type: ignore[arg-type]
    assert cut is not None
    (h, w, _), z = WALKER_HWL, 10.0
    expected = (FOCAL_PX / z) ** 2 * h * w * PERSON_SHARE
    for view in (cut.left, cut.right):
        rim = RIM_TOLERANCE_PX * 2 * (h + w) * FOCAL_PX / z
        assert view.opacity.sum() == pytest.approx(expected, abs=rim)
    other = scene(labels(), seed=5)  # nothing stands there
    assert cut_out(other.left, other.right, geometry=other.geometry, objects=DONOR, row=0) is None  # type: ignore[arg-type]


@pytest.mark.parametrize(("x_m", "z_m"), [(1.0, 10.0), (-2.0, 16.0), (3.0, 12.0)])
def test_pasted_pixels_agree_with_their_label(x_m: float, z_m: float) -> None:
    donor = scene(DONOR)
    cut = cut_out(donor.left, donor.right, geometry=donor.geometry, objects=DONOR, row=0)  # type: ignore[arg-type]
    assert cut is not None
    target = scene(labels(), seed=3)
    place = place_at(cut, target, x_m=x_m, z_m=z_m, ground=FLAT)
    frame, objects = paste_object(target, labels(), cut=cut, place=place)
    assert len(objects) == 1 and objects.class_names[objects.class_id[0]] == "Pedestrian"
    np.testing.assert_allclose(objects.center_in_camera[0], [x_m, HEIGHT_M - WALKER_HWL[0] / 2, z_m], atol=EXACT)
    assert objects.alpha_rad[0] == pytest.approx(DONOR.alpha_rad[0], abs=EXACT)
    assert objects.yaw_rad[0] == pytest.approx(objects.alpha_rad[0] + np.arctan2(x_m, z_m), abs=EXACT)
    spots = objects.center_in_camera[0] + np.array([[-0.35, -0.875, 0], [0.35, 0.875, 0]])
    expected = [project_to_image(P, spots)[0].ravel() for P in (target.geometry.P2, target.geometry.P3)]
    for image, box in zip((frame.left, frame.right), expected, strict=True):
        rows, columns = np.nonzero(image[..., 2].astype(int) - image[..., 0] > 60)  # the board is red
        found = [columns.min(), rows.min(), columns.max(), rows.max()]
        np.testing.assert_allclose(found, box, atol=EDGE_TOLERANCE_PX)
    outline = project_to_image(target.geometry.P2, box_corners(*_box(objects)))[0][0]
    np.testing.assert_allclose(
        objects.box_in_left_image[0], [*outline.min(axis=0), *outline.max(axis=0)], atol=EDGE_TOLERANCE_PX
    )
    matcher = cv2.StereoSGBM.create(minDisparity=0, numDisparities=64, blockSize=5)
    grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in (frame.left, frame.right)]
    disparity = matcher.compute(grey[0], grey[1]) / 16
    (u, v), _ = project_to_image(target.geometry.P2, objects.center_in_camera[0])
    inside = disparity[round(v) - 8 : round(v) + 8, round(u) - 5 : round(u) + 5]
    assert np.median(inside) == pytest.approx(FOCAL_PX * BASELINE_M / z_m, abs=DISPARITY_TOLERANCE_PX)


def _box(objects: Objects3D) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return objects.center_in_camera, objects.size_hwl, objects.yaw_rad


def test_what_is_hidden_says_so() -> None:
    donor = scene(DONOR)
    cut = cut_out(donor.left, donor.right, geometry=donor.geometry, objects=DONOR, row=0)  # type: ignore[arg-type]
    assert cut is not None
    before = labels(("Pedestrian", 2.09, 20.0), ("Pedestrian", -3.0, 15.0), ("Car", 1.7, 12.0))
    target = scene(before, seed=2)
    place = place_at(cut, target, x_m=0.8, z_m=8.0, ground=FLAT)
    _, after = paste_object(target, before, cut=cut, place=place)
    names = [after.class_names[index] for index in after.class_id]
    assert names == ["Pedestrian", "Car", "Pedestrian"]  # the one behind is gone, the one beside and the half one stay
    assert after.occlusion.tolist() == [0, 1, 0]
    np.testing.assert_allclose(after.dont_care_boxes, before.box_in_left_image[:1])


def test_ground_is_where_objects_stand() -> None:
    assert free_ground.ground_of(labels()).y_at(20.0) == pytest.approx(free_ground.CAMERA_HEIGHT_M)
    many = labels(*[("Pedestrian", x, z) for x in (-3.0, 3.0) for z in (8.0, 20.0, 30.0)])
    lower = replace(many, center_in_camera=many.center_in_camera + np.array([0, 0.15, 0]))
    assert free_ground.ground_of(lower).y_at(15.0) == pytest.approx(1.8, abs=0.04)


def test_nothing_stands_in_the_air_or_behind_a_wall() -> None:
    objects = labels()
    free, walled = (free_ground.scene_disparity(scene(objects, wall_depth_m=depth)) for depth in (60.0, 9.0))
    box, disparity_px = np.array([420.0, 60.0, 470.0, 200.0]), FOCAL_PX * BASELINE_M / 14.0
    assert free_ground.is_in_front(free, box, disparity_px)
    assert not free_ground.is_in_front(walled, box, disparity_px)
    at = {"center": np.array([0.0, 0.8, 12.0]), "size_hwl": np.array(WALKER_HWL)}
    assert free_ground.is_on_ground(free, geometry(), **at, ground=FLAT)
    assert not free_ground.is_on_ground(free, geometry(), **at, ground=free_ground.Ground(0.9, 0.0))


def test_footprints() -> None:
    def footprint(x: float, yaw: float) -> np.ndarray:
        return free_ground.footprint_of(np.array([x, 0, 10]), np.array([1.5, 1.8, 4.0]), yaw)

    assert free_ground.footprints_apart(footprint(0, 0), [])
    assert not free_ground.footprints_apart(footprint(0, 0), [footprint(3.9, 0)])
    assert free_ground.footprints_apart(footprint(0, np.pi / 2), [footprint(2.2, np.pi / 2)])
    assert not free_ground.footprints_apart(footprint(0, 0.8), [footprint(2.2, np.pi / 2)])


def test_a_position_is_the_same_sample_whatever_came_before(toy: ModuleType) -> None:
    scenes = Scenes(DONOR, labels(("Pedestrian", -2.0, 12.0)), labels(("Car", 2.0, 15.0)))
    chosen = toy.tiny_preset()

    def stream(share: float) -> MixedFrames:
        bank = ObjectBank([scenes], ("Pedestrian",))  # type: ignore[list-item]
        paster = ObjectPaster(bank, share) if share else None
        maker = SampleMaker(chosen, toy.plain_priors(chosen))
        return MixedFrames([scenes], [1], maker=maker, seed=4, changes=FrameChanges(paster))  # type: ignore[list-item]

    plain, none, all_ = stream(0.0), stream(1e-12), stream(1.0)
    counts = []
    for position in range(6):
        one, same, more = plain[position], none[position], all_[position]
        np.testing.assert_array_equal(one.left, same.left)
        np.testing.assert_array_equal(one.targets.label, same.targets.label)
        counts.append(more.targets.object_count - one.targets.object_count)
    assert max(counts) > 0 and min(counts) >= 0
    np.testing.assert_array_equal(stream(1.0)[5].left, all_[5].left)
