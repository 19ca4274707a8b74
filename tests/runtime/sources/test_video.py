"""Recorded video."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.contracts.errors import FrameError, SourceError
from runtime.contracts.geometry import StereoGeometry
from runtime.rig import format_geometry
from runtime.sources.base import as_sequence
from runtime.sources.factory import open_source

GREY_TOLERANCE = 4
"""Grey levels that motion JPEG may be off on a flat picture."""
FPS = 25.0


def record(path: Path, count: int, *, width: int = 64, offset: int = 0, split: bool = False) -> None:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), FPS, (width, 32))
    assert writer.isOpened()
    for number in range(count):
        image = np.full((32, width, 3), (20 * number + offset) % 256, np.uint8)
        if split:
            image[:, width // 2 :] += 100
        writer.write(image)
    writer.release()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    left = np.array([[100.0, 0, 32, 0], [0, 100.0, 16, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -50.0
    (tmp_path / "rig.json").write_text(format_geometry(StereoGeometry(left, right, (64, 32))), encoding="utf-8")
    return tmp_path


def test_two_files_stay_in_step_in_any_order(folder: Path) -> None:
    record(folder / "l.avi", 6)
    record(folder / "r.avi", 6, offset=10)
    with as_sequence(open_source(f"video:{folder}/l.avi,{folder}/r.avi?geometry={folder}/rig.json")) as source:
        assert len(source) == 6
        assert source.frame_hz == FPS
        for index in (0, 1, 4, 2, 5):
            frame = source[index]
            assert abs(int(frame.left[5, 5, 0]) - 20 * index) <= GREY_TOLERANCE
            assert frame.right is not None
            assert abs(int(frame.right[5, 5, 0]) - 20 * index - 10) <= GREY_TOLERANCE
            assert frame.timestamp_secs == index / FPS
            assert frame.frame_id == f"{index:06d}"


def test_choice_of_frames(folder: Path) -> None:
    record(folder / "l.avi", 6)
    uri = f"video:{folder}/l.avi,{folder}/l.avi?geometry={folder}/rig.json&start=1&step=2"
    with open_source(uri) as source:
        assert [frame.frame_id for frame in source] == ["000001", "000003", "000005"]


@pytest.mark.parametrize("views", ["both", "left"])
def test_side_by_side(folder: Path, views: str) -> None:
    record(folder / "both.avi", 2, width=128, split=True)
    uri = f"video:{folder}/both.avi?layout=side-by-side&geometry={folder}/rig.json&views={views}"
    with as_sequence(open_source(uri)) as source:
        frame = source[1]
        assert frame.size_wh == (64, 32)
        assert abs(int(frame.left[5, 5, 0]) - 20) <= GREY_TOLERANCE
        if views == "left":
            assert frame.right is None
        else:
            assert frame.right is not None
            assert abs(int(frame.right[5, 60, 0]) - 120) <= GREY_TOLERANCE


def test_unequal_lengths(folder: Path) -> None:
    record(folder / "l.avi", 3)
    record(folder / "r.avi", 2)
    with pytest.raises(SourceError, match="left has 3 frames and right 2"):
        open_source(f"video:{folder}/l.avi,{folder}/r.avi?geometry={folder}/rig.json")


def test_a_container_that_does_not_count_is_counted(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record(folder / "l.mkv", 7)
    monkeypatch.setattr(cv2, "CAP_PROP_FRAME_COUNT", cv2.CAP_PROP_FRAME_WIDTH)  # what is told, 64, is wrong
    uri = f"video:{folder}/l.mkv,{folder}/l.mkv?geometry={folder}/rig.json"
    with as_sequence(open_source(uri)) as source:
        assert len(source) == 7
        assert abs(int(source[6].left[5, 5, 0]) - 120) <= GREY_TOLERANCE


def test_closing_ends_a_long_seek(folder: Path) -> None:
    record(folder / "l.avi", 30)
    source = open_source(f"video:{folder}/l.avi,{folder}/l.avi?geometry={folder}/rig.json")
    with as_sequence(source) as frames:
        frames[0]
    with pytest.raises(FrameError, match="ends at frame 1"):
        frames[29]
    with pytest.raises(FrameError, match="ends at frame 0"):
        frames[0]


def test_a_file_that_is_cut_short(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    record(folder / "l.avi", 30)
    content = (folder / "l.avi").read_bytes()
    (folder / "l.avi").write_bytes(content[: len(content) // 2])
    uri = f"video:{folder}/l.avi,{folder}/l.avi?geometry={folder}/rig.json"
    with pytest.raises((FrameError, SourceError)), open_source(uri) as source:
        list(source)
    assert capfd.readouterr().err == ""
