"""Folders of KITTI text: which frames are read, and one line for each way to be wrong."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.evaluation.text_folders import read_text_frames
from runtime.contracts.errors import FormatError, SourceError

LINE = "Car 0.00 0 0.10 600.00 150.00 720.00 220.00 1.50 1.60 3.90 0.00 1.60 20.00 0.30"


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    labels, detections = tmp_path / "label_2", tmp_path / "found"
    for name in ("000000", "000001", "0010/000002"):
        for folder, text in ((labels, LINE), (detections, f"{LINE} 0.5")):
            path = folder / f"{name}.txt"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text + "\n")
    return labels, detections


def test_frames_are_those_of_the_detection_files(folders: tuple[Path, Path]):
    labels, detections = folders
    (labels / "999999.txt").write_text("")
    frames = read_text_frames(labels, detections)
    assert frames.frame_ids == ("000000", "000001", "0010/000002")
    assert [len(item) for item in frames.labels] == [1, 1, 1]


def test_an_empty_file_is_an_empty_frame(folders: tuple[Path, Path]):
    labels, detections = folders
    (detections / "000000.txt").write_text("")
    (labels / "000001.txt").write_text("")
    frames = read_text_frames(labels, detections)
    assert len(frames.detections[0]) == 0
    assert len(frames.labels[1]) == 0


def test_split_chooses_frames_in_its_order(folders: tuple[Path, Path], tmp_path: Path):
    split = tmp_path / "val.txt"
    split.write_text("000001\n000000\n")
    assert read_text_frames(*folders, split).frame_ids == ("000001", "000000")


@pytest.mark.parametrize(("folder", "word"), [(0, "a label file"), (1, "a result file")])
def test_missing_file_of_the_split(folders: tuple[Path, Path], tmp_path: Path, folder: int, word: str):
    split = tmp_path / "val.txt"
    split.write_text("000000\n000001\n")
    (folders[folder] / "000001.txt").unlink()
    with pytest.raises(SourceError, match=f"000001.txt is missing .1 of 2 are., expected {word}"):
        read_text_frames(*folders, split)


def test_missing_label_without_a_split(folders: tuple[Path, Path]):
    (folders[0] / "000000.txt").unlink()
    with pytest.raises(SourceError, match=r"000000\.txt is missing"):
        read_text_frames(*folders)


@pytest.mark.parametrize("missing", [0, 1])
def test_missing_folder(folders: tuple[Path, Path], tmp_path: Path, missing: int):
    paths = list(folders)
    paths[missing] = tmp_path / "nowhere"
    with pytest.raises(SourceError, match="is not a folder"):
        read_text_frames(*paths)


def test_no_detection_file(folders: tuple[Path, Path], tmp_path: Path):
    empty = tmp_path / "empty"
    empty.mkdir()
    with pytest.raises(SourceError, match=r"holds no \.txt file"):
        read_text_frames(folders[0], empty)


@pytest.mark.parametrize(
    ("text", "error", "message"),
    [
        (None, SourceError, "is not a file"),
        ("", FormatError, "names no frame"),
        ("000000\n000000\n", FormatError, "twice"),
    ],
)
def test_bad_split(folders: tuple[Path, Path], tmp_path: Path, text: str | None, error: type, message: str):
    split = tmp_path / "val.txt"
    if text is not None:
        split.write_text(text)
    with pytest.raises(error, match=message):
        read_text_frames(*folders, split)


def test_text_of_another_kind(folders: tuple[Path, Path]):
    (folders[1] / "000000.txt").write_bytes(b"\xff\xfe\x00 not KITTI")
    with pytest.raises(FormatError, match=r"000000\.txt line 1"):
        read_text_frames(*folders)
