"""Zoomed frames whose labels, projections and pixels agree; camera faults; frames that teach disparity alone."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import ModuleType

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.ablations import ablated  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import preset  # noqa: E402
from edge.training.assign import BACKGROUND, IGNORED  # noqa: E402
from edge.training.camera_faults import ViewFaults, draw_faults, with_faults  # noqa: E402
from edge.training.frame_changes import FrameChanges, frame_changes  # noqa: E402
from edge.training.losses import ImageTargets, box_loss, class_loss  # noqa: E402
from edge.training.run_record import RunSettings  # noqa: E402
from edge.training.samples import SampleMaker  # noqa: E402
from edge.training.start import check_unlabelled  # noqa: E402
from edge.training.step import train_step  # noqa: E402
from edge.training.stream import MixedFrames, batches, collate  # noqa: E402
from edge.training.zoom import Zoom, draw_zoom, zoomed, zoomed_geometry, zoomed_objects  # noqa: E402
from runtime.contracts.errors import EdgeError, FrameError, SourceError  # noqa: E402
from runtime.contracts.frame import StereoFrame  # noqa: E402
from runtime.contracts.geometry import StereoGeometry, project_to_image  # noqa: E402
from runtime.contracts.objects import Objects3D, box_corners  # noqa: E402
from runtime.preprocess import network_view  # noqa: E402

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]

EXACT_PX, EXACT_M = 1e-6, 1e-9  # the same float64 arithmetic in another order
BASELINE_TOLERANCE_M = 2e-5  # KITTI's two cameras differ by 16 um along the axis, times a column of 600 px
DISPARITY_TOLERANCE_PX = 1e-2  # the same
CENTROID_TOLERANCE_PX = 0.1  # of a blob after bilinear resampling
QUARTER = np.pi / 2


def geometry(toy: ModuleType) -> StereoGeometry:
    return StereoGeometry(toy.P2, toy.P3, (1242, 375))


def one(center: tuple[float, float, float], yaw_rad: float, box: tuple[float, ...] = (300, 160, 420, 260)) -> Objects3D:
    return Objects3D(
        class_id=np.array([0]),
        box_in_left_image=np.array([box]),
        center_in_camera=np.array([center]),
        size_hwl=np.array([[1.5, 1.6, 3.9]]),
        alpha_rad=np.array([yaw_rad - np.arctan2(center[0], center[2])]),
        yaw_rad=np.array([yaw_rad]),
        truncation=np.zeros(1),
        occlusion=np.zeros(1),
        track_id=np.zeros(1),
        dont_care_boxes=np.array([[10.0, 150, 60, 190]]),
        class_names=("Car",),
    )


def outlines(objects: Objects3D, projection: np.ndarray) -> np.ndarray:
    corners = box_corners(objects.center_in_camera, objects.size_hwl, objects.yaw_rad)
    pixels, _ = project_to_image(projection, corners)
    return np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1)


@given(
    factor=st.floats(0.8, 1.3),
    across=st.floats(0, 1),
    x=st.floats(-10, 10),
    z=st.floats(6, 60),
    quarter=st.integers(-2, 1),
)
@settings(max_examples=40, deadline=None)
def test_zoomed_labels_project_onto_zoomed_boxes_in_both_views(
    toy: ModuleType, factor: float, across: float, x: float, z: float, quarter: int
) -> None:
    before = geometry(toy)
    zoom = Zoom(factor, across * max(factor - 1, 0) * 1242, max(factor - 1, 0) * 172, (1242, 375))
    after = zoomed_geometry(before, zoom)
    objects = one((x, 1.0, z), quarter * QUARTER)
    moved = zoomed_objects(replace(objects, box_in_left_image=np.array([[500.0, 160, 600, 200]])), zoom)
    for P_before, P_after in ((before.P2, after.P2), (before.P3, after.P3)):
        expected = outlines(objects, P_before) * factor - [zoom.left, zoom.top] * 2
        np.testing.assert_allclose(outlines(moved, P_after), expected, atol=EXACT_PX)
    assert after.focal_px == pytest.approx(before.focal_px)
    assert after.baseline_m == pytest.approx(before.baseline_m, abs=BASELINE_TOLERANCE_M)
    center = moved.center_in_camera[0]
    (left, depth_m), (right, _) = (project_to_image(P, center) for P in (after.P2, after.P3))
    assert left[0] - right[0] == pytest.approx(after.focal_px * after.baseline_m / depth_m, abs=DISPARITY_TOLERANCE_PX)
    assert center[:2].tolist() == objects.center_in_camera[0, :2].tolist()
    assert center[2] * factor == pytest.approx(z, abs=EXACT_M)
    turned = moved.alpha_rad + np.arctan2(center[0], center[2]) - moved.yaw_rad
    assert np.cos(turned[0]) == pytest.approx(1.0)


def test_a_turned_box_keeps_its_squeezed_area_and_heading() -> None:
    zoom = Zoom(1.15, 0, 0, (1242, 375))
    moved = zoomed_objects(one((2.0, 1.0, 20.0), 0.7), zoom)
    _, width, length = moved.size_hwl[0]
    assert width * length == pytest.approx(1.6 * 3.9 / 1.15)
    assert np.tan(moved.yaw_rad[0]) == pytest.approx(np.tan(0.7) / 1.15)


def test_the_window_cuts_boxes_and_drops_what_left() -> None:
    zoom = Zoom(1.2, 100.0, 30.0, (1242, 375))
    moved = zoomed_objects(one((-8.0, 1.0, 20.0), 0.0, (0, 160, 120, 260)), zoom)
    assert moved.truncation[0] == pytest.approx(1 - 44 / 144)
    assert moved.box_in_left_image[0].tolist() == [0, 162, 44, 282]
    assert len(moved.dont_care_boxes) == 0
    assert len(zoomed_objects(one((-8.0, 1.0, 20.0), 0.0, (0, 160, 80, 260)), zoom)) == 0
    assert len(zoomed_objects(Objects3D.empty(("Car",)), zoom)) == 0


def test_pixels_go_where_labels_go(toy: ModuleType) -> None:
    frame, spot = toy.DrawnFrames()[0], (400, 200)
    black = np.zeros_like(frame.left)
    cv2.circle(black, spot, 12, (255, 255, 255), -1)
    frame = replace(frame, left=black, right=black)
    for zoom in (Zoom(1.15, 60.0, 20.0, (1242, 375)), Zoom(0.95, 0.0, 0.0, (1179, 356))):
        changed, _ = zoomed(frame, Objects3D.empty(("Car",)), zoom)
        assert changed.size_wh == zoom.size_wh
        rows, columns = np.nonzero(changed.left[..., 0] > 127)
        expected = np.array(spot) * zoom.factor - [zoom.left, zoom.top]
        np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=CENTROID_TOLERANCE_PX)


def test_the_network_sees_the_zoomed_pair_as_its_own_camera(toy: ModuleType) -> None:
    manifest = preset("compact").manifest()
    before = network_view(geometry(toy), manifest)
    for seed in range(8):
        zoom = draw_zoom(geometry(toy), np.random.default_rng(seed))
        after = network_view(zoomed_geometry(geometry(toy), zoom), manifest)
        assert after.scale == pytest.approx(before.scale)
        if zoom.factor >= 1:
            assert after.top_row == before.top_row
            assert 0 <= zoom.left <= (zoom.factor - 1) * 1242


def test_zoom_wants_a_fixed_focal_length() -> None:
    with pytest.raises(EdgeError, match="expected one of fixed focal length"):
        frame_changes(preset("paper"), [], method=None, zoom=0.3)
    assert frame_changes(preset("compact"), [], method=None, zoom=0.3) == FrameChanges(zoom=0.3)


def test_no_fault_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    assert with_faults([], []) == []
    np.testing.assert_array_equal(with_faults([image], [ViewFaults()])[0], image)


@pytest.mark.parametrize(
    "faults",
    [
        ViewFaults(curve=np.zeros((256, 3), np.uint8)),
        ViewFaults(blur_px=1.0),
        ViewFaults(noise=(5.0, 3)),
        ViewFaults(jpeg_quality=40),
        ViewFaults(shift_px=0.7),
        ViewFaults(roll_rad=0.01),
    ],
)
def test_each_fault_changes_the_picture_and_repeats(faults: ViewFaults) -> None:
    image = np.random.default_rng(0).integers(20, 230, (40, 60, 3)).astype(np.uint8)
    (changed,), (again,) = with_faults([image], [faults]), with_faults([image], [faults])
    assert changed.shape == image.shape and changed.dtype == np.uint8
    assert not np.array_equal(changed, image)
    np.testing.assert_array_equal(changed, again)


def test_noise_has_its_level_and_no_pattern_down_the_rows() -> None:
    grey = np.full((192, 896, 3), 128, np.uint8)
    noise = with_faults([grey], [ViewFaults(noise=(6.0, 1))])[0].astype(float) - 128
    assert noise.std() == pytest.approx(6.0, rel=0.02)
    assert abs(noise.mean()) < 0.1
    assert np.abs(noise.mean(axis=0)).max() < 6.0 / np.sqrt(192) * 5


def test_faults_differ_between_views_and_leave_the_left_view_in_its_rows() -> None:
    drawn = [draw_faults(np.random.default_rng(seed)) for seed in range(60)]
    assert all(left.shift_px == left.roll_rad == 0 for left, _ in drawn)
    assert any(right.shift_px for _, right in drawn)
    lit = [(left.curve, right.curve) for left, right in drawn if left.curve is not None and right.curve is not None]
    assert lit and all(not np.array_equal(one, other) for one, other in lit)


def test_a_crooked_view_is_never_the_one_that_labels_are_for(toy: ModuleType) -> None:
    chosen = toy.tiny_preset()
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    frame, objects = toy.DrawnFrames()[0], toy.DrawnFrames().labels(0)
    crooked = [ViewFaults(), ViewFaults(shift_px=0.7, roll_rad=0.01)]
    pairs = []
    for seed in range(6):  # some are mirrored
        clean = maker.make(frame, objects, np.random.RandomState(seed))
        faulty = maker.make(frame, objects, np.random.RandomState(seed), faults=crooked)
        np.testing.assert_array_equal(clean.left, faulty.left)
        assert not np.array_equal(clean.right, faulty.right)
        pairs.append(clean.targets.label)
    assert any(not np.array_equal(label, pairs[0]) for label in pairs)


def test_faults_are_for_the_network_alone(toy: ModuleType) -> None:
    chosen = toy.tiny_preset()
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    frame, objects = toy.DrawnFrames()[0], toy.DrawnFrames().labels(0)
    frame = replace(frame, right=np.roll(frame.left, -24, axis=1))
    clean = maker.make(frame, objects, np.random.RandomState(1))
    faulty = maker.make(frame, objects, np.random.RandomState(1), faults=[ViewFaults(blur_px=1.0)] * 2)
    assert not np.array_equal(clean.left, faulty.left)
    np.testing.assert_array_equal(clean.disparity, faulty.disparity)
    np.testing.assert_array_equal(clean.targets.label, faulty.targets.label)


def test_unlabelled_frames_teach_disparity_alone(toy: ModuleType) -> None:
    chosen, frames = toy.tiny_preset(), toy.DrawnFrames()
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    with pytest.raises(SourceError, match="no labelled frame"):
        MixedFrames([], [], maker=maker, seed=1, unlabelled=[frames])
    mixed = MixedFrames([frames], [1], maker=maker, seed=1, unlabelled=[frames])
    assert mixed.epoch_length == 2 * len(frames)
    samples = [mixed[position] for position in range(mixed.epoch_length)]
    silent = [sample for sample in samples if (sample.targets.label == IGNORED).all()]
    assert len(silent) == len(frames)
    assert all(sample.targets.object_count == 0 and sample.disparity is not None for sample in silent)
    assert all((s.targets.label == BACKGROUND).any() for s in samples if not any(s is other for other in silent))
    batch = collate(silent[:2])
    logits = torch.zeros(2, len(silent[0].targets.label), 3)
    targets: list[ImageTargets] = batch.targets
    assert class_loss(logits, targets, torch.ones(3), empty_images_teach=True).item() == 0
    assert box_loss(logits[..., 0], torch.zeros(*logits.shape[:2], 12), targets).item() == 0


def test_a_batch_of_unlabelled_frames_moves_the_weights(toy: ModuleType) -> None:
    chosen, frames = toy.tiny_preset(), toy.DrawnFrames()
    mixed = MixedFrames([frames], [1], maker=SampleMaker(chosen, toy.plain_priors(chosen)), seed=1, unlabelled=[frames])
    samples = [mixed[position] for position in range(mixed.epoch_length)]
    unlabelled = collate([sample for sample in samples if not sample.labelled][:2])
    assert unlabelled.unlabelled == 2
    run = RunSettings(steps=1, batch_size=2, learning_rate=1e-3, final_learning_rate=1e-5, mixed_precision=False)
    moved = {}
    for name, batch in (("unlabelled", unlabelled), ("empty", replace(unlabelled, unlabelled=0))):
        detector = StereoDetector(chosen)
        before = copy.deepcopy(dict(detector.named_parameters()))
        optimiser = torch.optim.Adam(detector.parameters(), lr=run.learning_rate)
        train_step(detector, chosen, batch, optimiser=optimiser, settings=run)
        moved[name] = [key for key, value in detector.named_parameters() if not torch.equal(value, before[key])]
    assert any("disparity_branch" in name for name in moved["unlabelled"])
    assert any("backbone" in name for name in moved["unlabelled"])
    assert not any("head" in name for name in moved["unlabelled"])
    assert moved["empty"] == []  # as the official code does with labelled frames that show no object


def test_unlabelled_frames_take_nothing_from_the_class_loss(toy: ModuleType) -> None:
    chosen, frames = toy.tiny_preset(), toy.DrawnFrames()
    mixed = MixedFrames([frames], [1], maker=SampleMaker(chosen, toy.plain_priors(chosen)), seed=1, unlabelled=[frames])
    samples = [mixed[position] for position in range(mixed.epoch_length)]
    taught = [sample for sample in samples if sample.labelled and sample.targets.object_count][:2]
    silent = [sample for sample in samples if not sample.labelled][:2]
    run = RunSettings(steps=1, batch_size=4, learning_rate=1e-9, final_learning_rate=1e-9, mixed_precision=False)
    losses = []
    for samples_of_it in (taught, taught + silent):
        torch.manual_seed(0)
        detector = StereoDetector(chosen)
        for module in detector.modules():
            if isinstance(module, torch.nn.Dropout):
                module.p = 0.0
        optimiser = torch.optim.Adam(detector.parameters(), lr=run.learning_rate)
        losses.append(
            train_step(
                detector, chosen, collate(samples_of_it), optimiser=optimiser, settings=replace(run, freeze_norms=True)
            )
        )
    assert losses[1]["class_loss"] == pytest.approx(losses[0]["class_loss"], rel=1e-4)


def test_a_frame_that_cannot_be_read_is_told_as_it_is(toy: ModuleType) -> None:
    class Broken(toy.DrawnFrames):  # type: ignore[name-defined, misc]
        def __getitem__(self, index: int) -> StereoFrame:
            raise FrameError("frame 000003: 000003.png cannot be read")

    chosen = toy.tiny_preset()
    mixed = MixedFrames([Broken()], [1], maker=SampleMaker(chosen, toy.plain_priors(chosen)), seed=1)
    for workers in (0, 1):
        with pytest.raises(FrameError, match=r"^frame 000003: 000003\.png cannot be read$"):
            next(batches(mixed, first_step=0, last_step=2, batch_size=2, workers=workers))


def test_a_video_cannot_be_read_in_any_order() -> None:
    with pytest.raises(EdgeError, match="is a video"):
        check_unlabelled(preset("compact"), ["video:drive.mp4?layout=side-by-side&geometry=rig.json"])


def test_unlabelled_frames_need_a_preset_that_learns_disparity() -> None:
    for chosen in (preset("mono"), ablated(preset("compact"), ["no-disparity-supervision"])):
        check_unlabelled(chosen, [])
        with pytest.raises(EdgeError, match="learns no disparity"):
            check_unlabelled(chosen, ["frames:drive"])
    check_unlabelled(preset("compact"), ["frames:drive"])
