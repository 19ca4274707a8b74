"""The four KITTI layouts, on folders made here and on real frames where they are."""

from __future__ import annotations

import shutil
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.contracts.errors import FormatError, FrameError, SourceError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_calib
from runtime.sources.base import FrameSequence, as_sequence
from runtime.sources.factory import open_source
from runtime.sources.kitti_files import read_seconds, time_of
from runtime.sources.kitti_object import bundled_split

SIZE_WH = (64, 32)
TIME_TOLERANCE_SECS = 1e-6
"""Times are written with microseconds at least."""
PACE_TOLERANCE_SECS = 0.2
"""A busy machine may wake a sleeper late."""


def calibration() -> str:
    left = np.array([[100.0, 0, 32, 0], [0, 100.0, 16, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -50.0
    return format_calib(StereoGeometry(left, right, SIZE_WH))


def write_pair(left: Path, right: Path, stem: str, *, suffix: str = ".png", grey: int = 90) -> None:
    for folder in (left, right):
        folder.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / f"{stem}{suffix}"), np.full((SIZE_WH[1], SIZE_WH[0], 3), grey, np.uint8))


@pytest.fixture
def tracking(tmp_path: Path) -> Path:
    root = tmp_path / "tracking"
    training = root / "training"
    for name, numbers in (("0000", (0, 1, 4)), ("0010", (0, 1))):
        for number in numbers:
            write_pair(training / "image_02" / name, training / "image_03" / name, f"{number:06d}", suffix=".webp")
    for folder in ("calib", "label_02"):
        (training / folder).mkdir()
    for name in ("0000", "0010"):
        (training / "calib" / f"{name}.txt").write_text(calibration(), encoding="utf-8")
    labels = "1 7 Car 0 0 0.1 1 2 3 4 1.5 1.6 3.9 1 1.6 20 0.2\n4 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1 -1 -1 -1\n"
    (training / "label_02" / "0000.txt").write_text(labels, encoding="utf-8")
    return root


def test_object_frames_in_any_order(tiny_drive: Path) -> None:
    with as_sequence(open_source(f"kitti-object:{tiny_drive}")) as source:
        assert [source.frame_id(index) for index in range(len(source))] == ["000000", "000001", "000002", "000003"]
        assert source[3].right is not None
        assert int(source[3].right[0, 0, 0]) == 120
        assert int(source[1].right[0, 0, 0]) == 40
        assert source[-1].frame_id == "000003"
        assert source[-1].sequence == 3
        with pytest.raises(IndexError):
            source[4]
        labels = source.labels(0)
        assert labels is not None
        assert labels.class_names[labels.class_id[0]] == "Car"


def test_object_split_and_choice(tiny_drive: Path) -> None:
    with open_source(f"kitti-object:{tiny_drive}?split=val") as source:
        assert [frame.frame_id for frame in source] == ["000002", "000003"]
    with open_source(f"kitti-object:{tiny_drive}?start=1&step=2&limit=1") as source:
        assert [(frame.frame_id, frame.sequence) for frame in source] == [("000001", 0)]


def test_object_left_view_needs_no_right_image(tiny_drive: Path) -> None:
    shutil.rmtree(tiny_drive / "training" / "image_3")
    with pytest.raises(FrameError, match="no right image"):
        open_source(f"kitti-object:{tiny_drive}")
    with open_source(f"kitti-object:{tiny_drive}?views=left") as source:
        assert all(frame.right is None for frame in source)


def test_object_only_wanted_frames_must_be_whole(tiny_drive: Path) -> None:
    (tiny_drive / "training" / "image_3" / "000003.png").unlink()
    with open_source(f"kitti-object:{tiny_drive}?limit=3") as source:
        assert len(list(source)) == 3


def test_object_split_that_names_a_missing_frame(tiny_drive: Path) -> None:
    (tiny_drive / "ImageSets" / "val.txt").write_text("000002\n999999\n", encoding="utf-8")
    with pytest.raises(FrameError, match="999999"):
        open_source(f"kitti-object:{tiny_drive}?split=val")
    (tiny_drive / "ImageSets" / "val.txt").write_text("\n", encoding="utf-8")
    with pytest.raises(SourceError, match="empty"):
        open_source(f"kitti-object:{tiny_drive}?split=val")


def test_object_without_labels(tiny_drive: Path) -> None:
    shutil.rmtree(tiny_drive / "training" / "label_2")
    with as_sequence(open_source(f"kitti-object:{tiny_drive}")) as source:
        assert source.labels(0) is None


def test_object_test_split_lies_in_testing(tiny_drive: Path) -> None:
    shutil.copytree(tiny_drive / "training", tiny_drive / "testing")
    (tiny_drive / "ImageSets" / "test.txt").write_text("000001\n", encoding="utf-8")
    with as_sequence(open_source(f"kitti-object:{tiny_drive}?split=test")) as source:
        assert source[0].frame_id == "000001"


def test_tracking_all_sequences(tracking: Path) -> None:
    with as_sequence(open_source(f"kitti-tracking:{tracking}")) as source:
        names = [source.frame_id(index) for index in range(len(source))]
        assert names == ["0000/000000", "0000/000001", "0000/000004", "0010/000000", "0010/000001"]
        counts = [None if (labels := source.labels(index)) is None else len(labels) for index in range(5)]
        assert counts == [0, 1, 0, None, None]
        labels = source.labels(1)
        assert labels is not None
        assert labels.track_id.tolist() == [7]
        third = source.labels(2)
        assert third is not None
        assert len(third.dont_care_boxes) == 1
        assert source[2].timestamp_secs == pytest.approx(0.4, abs=TIME_TOLERANCE_SECS)


@pytest.mark.parametrize("name", ["0010", "10"])
def test_tracking_one_sequence(tracking: Path, name: str) -> None:
    with open_source(f"kitti-tracking:{tracking}?sequence={name}") as source:
        assert [frame.frame_id for frame in source] == ["0010/000000", "0010/000001"]


def test_tracking_unknown_sequence(tracking: Path) -> None:
    with pytest.raises(SourceError, match="0000, 0010"):
        open_source(f"kitti-tracking:{tracking}?sequence=0001")


def test_tracking_without_calibration(tracking: Path) -> None:
    (tracking / "training" / "calib" / "0010.txt").unlink()
    with pytest.raises(SourceError, match=r"0010\.txt"):
        open_source(f"kitti-tracking:{tracking}")


def test_raw(tmp_path: Path) -> None:
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    for number in range(2):
        write_pair(drive / "image_02" / "data", drive / "image_03" / "data", f"{number:010d}", suffix=".jpg")
    with pytest.raises(SourceError, match="calib_cam_to_cam"):
        open_source(f"kitti-raw:{drive}")
    raw = calibration().replace("P2:", "P_rect_02:").replace("P3:", "P_rect_03:")
    sizes = "S_rect_02: 6.400000e+01 3.200000e+01\n"
    (drive.parent / "calib_cam_to_cam.txt").write_text("calib_time: 09-Jan-2012\n" + sizes + raw, encoding="utf-8")
    times = "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.067890000\n"
    (drive / "image_02" / "timestamps.txt").write_text(times, encoding="utf-8")
    with as_sequence(open_source(f"kitti-raw:{drive}")) as source:
        assert source.frame_id(1) == "0000000001"
        gap = source[1].timestamp_secs - source[0].timestamp_secs
        assert gap == pytest.approx(0.103500555, abs=TIME_TOLERANCE_SECS)
        assert source.labels(0) is None


def test_odometry(tmp_path: Path) -> None:
    folder = tmp_path / "sequences" / "04"
    for number in range(3):
        write_pair(folder / "image_2", folder / "image_3", f"{number:06d}")
    (folder / "calib.txt").write_text(calibration(), encoding="utf-8")
    (folder / "times.txt").write_text("0.0\n0.05\n0.1\n", encoding="utf-8")
    with as_sequence(open_source(f"kitti-odometry:{tmp_path}?sequence=04")) as source:
        assert source.frame_id(2) == "04/000002"
        assert source[2].timestamp_secs == 0.1
    (folder / "times.txt").write_text("soon\n", encoding="utf-8")
    with pytest.raises(FormatError, match="line 1"):
        open_source(f"kitti-odometry:{tmp_path}")


def test_times(tmp_path: Path) -> None:
    assert read_seconds(tmp_path / "none.txt") is None
    assert time_of(7, None) == 0.7
    assert time_of(1, [3.0, 4.0]) == 4.0
    assert time_of(2, [3.0, 4.0]) == 0.2  # beyond the list


@pytest.mark.parametrize(("rate", "seconds"), [("rate=20", 0.15), ("rate", 0.3)])
def test_rate_paces_and_drops_nothing(rate: str, seconds: float, tiny_drive: Path) -> None:
    with open_source(f"kitti-object:{tiny_drive}?{rate}") as source:
        began = time.monotonic()
        assert len(list(source)) == 4
        assert seconds - 0.01 < time.monotonic() - began < seconds + PACE_TOLERANCE_SECS
        assert source.arrives_at_camera_pace


def test_a_stall_is_not_caught_up(tiny_drive: Path) -> None:
    with open_source(f"kitti-object:{tiny_drive}?rate=20") as source:
        times = []
        for frame in source:
            times.append(time.monotonic())
            if frame.sequence == 0:
                time.sleep(0.2)
    assert min(np.diff(times)[1:]) > 0.05 - 0.01


@pytest.mark.parametrize(
    ("uri", "count", "size_wh"),
    [
        ("kitti-object:{kitti}/object?split=train&step=20", 7, None),
        ("kitti-object:{kitti}/extra", 15, None),
        ("kitti-tracking:{kitti}/tracking?sequence=0010", 21, (1242, 375)),
        ("kitti-tracking:{kitti}/tracking?sequence=0000", 33, (1242, 375)),
        ("kitti-raw:{kitti}/raw/2011_09_26/2011_09_26_drive_0009_sync", 25, (1242, 375)),
        ("kitti-odometry:{kitti}/odometry?sequence=04", 10, (1226, 370)),
    ],
)
def test_real_frames(uri: str, count: int, size_wh: tuple[int, int] | None, kitti_dir: Path) -> None:
    with as_sequence(open_source(uri.format(kitti=kitti_dir))) as source:
        assert isinstance(source, FrameSequence)
        assert len(source) == count
        frame = source[count - 1]
        assert frame.right is not None
        assert size_wh in (None, frame.size_wh)
        assert 0.53 < frame.geometry.baseline_m < 0.54


def test_chens_split_where_the_folder_has_no_lists(tmp_path: Path) -> None:
    training = tmp_path / "training"
    (training / "calib").mkdir(parents=True)
    for stem in bundled_split("val"):
        (training / "calib" / f"{stem}.txt").write_text(calibration(), encoding="utf-8")
    image = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
    for folder in ("image_2", "image_3"):
        (training / folder).mkdir()
        for stem in bundled_split("val"):
            (training / folder / f"{stem}.png").touch()
        assert cv2.imwrite(str(training / folder / "000001.png"), image)
    with as_sequence(open_source(f"kitti-object:{tmp_path}?split=val")) as source:
        assert len(source) == 3769
        assert [source.frame_id(index) for index in range(3)] == ["000001", "000002", "000004"]
        assert source[0].frame_id == "000001"
    with pytest.raises(FrameError, match="000000"):
        open_source(f"kitti-object:{tmp_path}?split=train")
    with pytest.raises(SourceError, match=r"no split 'dev'.*train, val"):
        open_source(f"kitti-object:{tmp_path}?split=dev")


def test_chens_lists_share_no_frame() -> None:
    train, val = bundled_split("train"), bundled_split("val")
    assert (len(train), len(val)) == (3712, 3769)
    assert train == sorted(set(train)) and val == sorted(set(val))
    assert set(train) | set(val) == {f"{number:06d}" for number in range(7481)}  # none twice, none left out


def test_own_lists_win_over_the_bundled_ones(tiny_drive: Path) -> None:
    with as_sequence(open_source(f"kitti-object:{tiny_drive}?split=val")) as source:
        assert [source.frame_id(index) for index in range(len(source))] == ["000002", "000003"]


def test_unlisted_test_split_is_all_of_testing(tiny_drive: Path) -> None:
    shutil.copytree(tiny_drive / "training", tiny_drive / "testing")
    with as_sequence(open_source(f"kitti-object:{tiny_drive}?split=test")) as source:
        assert len(source) == 4
