"""Pictures: boxes land where they project to, whatever the camera's size, and behind the camera nothing breaks."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.contracts.errors import OutputError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry, project_to_image
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import Detections3D, Objects3D, box_corners
from runtime.sinks.base import FrameResult
from runtime.sinks.bird_eye import BirdEyeView, footprints
from runtime.sinks.boxes_in_image import EDGES, FACES, FRONT, draw_boxes
from runtime.sinks.canvas import CODEC_OF_SUFFIX, OverlaySink, PictureFolder, VideoFile
from runtime.sinks.overlay import OverlayRenderer, camera_size
from runtime.sinks.palette import CLASS_COLOURS, class_colour

NAMES = ("Car", "Pedestrian", "Cyclist")
LINE_TOLERANCE_PX = 2
"""A two-pixel line and rounding."""


def geometry(size_wh: tuple[int, int] = (620, 188)) -> StereoGeometry:
    left = np.array([[360.0, 0, size_wh[0] / 2, 22.0], [0, 360.0, size_wh[1] / 2, 0.1], [0, 0, 1, 0.003]])
    right = left.copy()
    right[0, 3] -= 360.0 * 0.54
    return StereoGeometry(left, right, size_wh)


def result(detections: Detections3D, *, size_wh: tuple[int, int] = (620, 188), frame_id: str = "000001") -> FrameResult:
    view = np.full((size_wh[1], size_wh[0], 3), 60, np.uint8)
    frame = StereoFrame(view, view, 0.1, 1, frame_id, geometry(size_wh))
    times = {"read": 4.0, "preprocess": 2.0, "inference": 60.0, "decode": 5.0, "total": 71.0}
    return FrameResult(frame, detections, times)


def boxes(*rows: tuple[float, float, float, float], class_id: int = 0) -> Detections3D:
    """Cars at (x, y, z) with a yaw."""
    table = np.array(rows, dtype=np.float64).reshape(-1, 4)
    count = len(table)
    return Detections3D(
        class_id=np.full(count, class_id),
        score=np.full(count, 0.8),
        box_in_left_image=np.zeros((count, 4)),
        center_in_camera=table[:, :3],
        size_hwl=np.tile([1.5, 1.6, 3.9], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=table[:, 3],
        class_names=NAMES,
    )


def labels_of(detections: Detections3D) -> Objects3D:
    count = len(detections)
    return Objects3D(
        class_id=np.full(count, KITTI_CLASSES.index("Car")),
        box_in_left_image=detections.box_in_left_image,
        center_in_camera=detections.center_in_camera,
        size_hwl=detections.size_hwl,
        alpha_rad=detections.alpha_rad,
        yaw_rad=detections.yaw_rad,
        truncation=np.zeros(count),
        occlusion=np.zeros(count),
        track_id=np.full(count, -1),
        dont_care_boxes=np.zeros((0, 4)),
        class_names=KITTI_CLASSES,
    )


def test_a_frame_without_boxes() -> None:
    picture = OverlayRenderer("a model", NAMES).draw(result(Detections3D.empty(NAMES)))
    assert picture.dtype == np.uint8
    assert picture.shape[0] % 2 == 0
    assert picture.shape[1] % 2 == 0


def test_faces_and_edges_make_a_box() -> None:
    assert len(EDGES) == 12
    assert sorted(corner for face in FACES for corner in face) == sorted(list(range(8)) * 3)
    corners = box_corners(np.zeros((1, 3)), np.array([[1.5, 1.6, 3.9]]), np.zeros(1))[0]
    assert (corners[list(FRONT), 0] > 0).all()  # yaw 0 looks along x
    for start, end in EDGES:
        assert np.count_nonzero(np.abs(corners[start] - corners[end]) > 1e-9) == 1


def test_box_is_drawn_where_it_projects_to() -> None:
    image = np.zeros((188, 620, 3), np.uint8)
    detections = boxes((1.0, 0.8, 15.0, 1.2))
    draw_boxes(image, geometry().P2, detections)
    corners = box_corners(detections.center_in_camera, detections.size_hwl, detections.yaw_rad)[0]
    pixels, _ = project_to_image(geometry().P2, corners)
    top = int(pixels[:, 1].min())  # the tag is above
    drawn = np.argwhere(image[top:, :, 0] > 100)[:, ::-1] + [0, top]
    assert np.abs(drawn.min(axis=0) - pixels.min(axis=0)).max() <= LINE_TOLERANCE_PX
    assert np.abs(drawn.max(axis=0) - pixels.max(axis=0)).max() <= LINE_TOLERANCE_PX
    for column, row in pixels.round().astype(int):
        patch = image[row - LINE_TOLERANCE_PX : row + 3, column - LINE_TOLERANCE_PX : column + 3]
        assert patch.max() > 100


@pytest.mark.parametrize(
    "row",
    [
        (0.0, 1.0, -10.0, 0.0),  # behind
        (0.0, 1.0, 0.0, 0.0),  # around the camera
        (1.5, 1.0, 1.0, 1.5),  # reaches behind the near plane
        (0.0, 1.0, 0.001, 0.3),
        (500.0, 1.0, 2.0, 0.0),  # far outside the image
        (0.0, 1.0, 5000.0, 0.0),
    ],
)
def test_boxes_at_odd_places_do_not_break(row: tuple[float, float, float, float]) -> None:
    picture = OverlayRenderer("a model", NAMES).draw(result(boxes(row, (0.0, 1.0, 20.0, 0.0))))
    assert picture.any()


def test_crowded_tags_leave_out_rather_than_cover() -> None:
    crowd = boxes(*[(0.1 * index, 0.8, 20.0 + index, 1.5) for index in range(30)])
    assert OverlayRenderer("a model", NAMES).draw(result(crowd)).any()


def test_footprint_equals_the_ground_corners_of_the_box() -> None:
    detections = boxes((2.0, 1.0, 20.0, 0.7))
    corners = box_corners(detections.center_in_camera, detections.size_hwl, detections.yaw_rad)[0]
    (ground,) = footprints(detections)
    for corner in ground:
        assert np.abs(corners[:, [0, 2]] - corner).sum(axis=1).min() < 1e-9
    front = corners[list(FRONT)][:, [0, 2]].mean(axis=0)
    np.testing.assert_allclose(ground[:2].mean(axis=0), front, atol=1e-9)


def test_bird_eye_puts_things_where_they_are() -> None:
    view = BirdEyeView((480, 630))
    near, far, right = (view.to_panel(np.array(point)) for point in ([0.0, 10.0], [0.0, 50.0], [5.0, 10.0]))
    assert far[1] < near[1]
    assert right[0] > near[0]
    assert far[0] == near[0] == 240.0
    bare = view.draw(geometry(), Detections3D.empty(NAMES), None)
    drawn = view.draw(geometry(), boxes((5.0, 1.0, 10.0, 1.57)), None)
    changed = np.argwhere((bare != drawn).any(axis=2)).mean(axis=0)[::-1]
    assert np.abs(changed - right).max() < 6.0
    assert np.array_equal(bare, view.draw(geometry(), Detections3D.empty(NAMES), None))


def test_labels_are_white_wires_in_both_views() -> None:
    empty = result(Detections3D.empty(NAMES))
    labelled = dataclasses.replace(empty, labels=labels_of(boxes((0.0, 1.0, 12.0, 0.2))))
    without, with_labels = (OverlayRenderer("m", NAMES).draw(item) for item in (empty, labelled))
    changed = (without != with_labels).any(axis=2)
    assert changed[:400, :1300].any()
    assert changed[:, 1460:].any()


@pytest.mark.parametrize(
    ("size_wh", "shown"), [((1242, 375), (1440, 434)), ((1280, 800), (1152, 720)), ((640, 480), (960, 720))]
)
def test_camera_image_fits(size_wh: tuple[int, int], shown: tuple[int, int]) -> None:
    assert camera_size(size_wh) == shown


def test_pictures_of_one_stream_have_one_size() -> None:
    renderer = OverlayRenderer("a model", NAMES)
    shapes = {renderer.draw(result(boxes(), size_wh=size)).shape for size in ((1242, 375), (1224, 370))}
    assert len(shapes) == 1


def test_classes_differ_in_colour() -> None:
    assert len(set(CLASS_COLOURS.values())) == len(CLASS_COLOURS)
    assert class_colour("Zebra") not in CLASS_COLOURS.values()


@pytest.mark.parametrize("suffix", [*CODEC_OF_SUFFIX, ".MP4"])
def test_video(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"run{suffix}"
    with OverlaySink(OverlayRenderer("a model", NAMES), [VideoFile(path, fps=10.0)]) as sink:
        for _ in range(3):
            sink.write(result(boxes((0.0, 1.0, 20.0, 0.0))))
    capture = cv2.VideoCapture(str(path))
    frames = 0
    while capture.read()[0]:
        frames += 1
    capture.release()
    assert frames == 3
    assert sink.summary() == f"3 video frames in {path}"


def test_a_video_that_cannot_be_opened(tmp_path: Path) -> None:
    path = tmp_path / "gone" / "run.mp4"
    video = VideoFile(path, fps=10.0)
    path.parent.rmdir()
    with pytest.raises(OutputError, match="cannot be opened"):
        video.write(np.zeros((64, 64, 3), np.uint8), "a")


def test_pictures(tmp_path: Path) -> None:
    folder = tmp_path / "pictures"
    with OverlaySink(OverlayRenderer("a model", NAMES), [PictureFolder(folder)]) as sink:
        sink.write(result(boxes((0.0, 1.0, 20.0, 0.0)), frame_id="0010/000003"))
    image = cv2.imread(str(folder / "0010" / "000003.jpg"))
    assert image is not None
    assert sink.summary() == f"1 pictures in {folder}"
