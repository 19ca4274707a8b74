"""Hashes that are remembered by what image files hold are those of the decoded frames."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.frame_hashes import FrameHashes
from calib.frames import CalibrationSet, geometry_hash, pixel_hash
from calib.overlap import overlap
from runtime.contracts.errors import FrameError
from runtime.sources.factory import open_sequence
from runtime.sources.pairs import ImagePairs

CALIBRATION = "P2: 20 0 16 0 0 20 8 0 0 0 1 0\nP3: 20 0 16 {shift} 0 20 8 0 0 0 1 0\n"


@pytest.fixture
def cache_home(tmp_path, monkeypatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def drive(tmp_path) -> str:
    training = tmp_path / "drive" / "training"
    draw = np.random.default_rng(5)
    for name in ("image_2", "image_3", "calib"):
        (training / name).mkdir(parents=True)
    for number in range(4):
        for name in ("image_2", "image_3"):
            image = draw.integers(0, 256, (16, 32, 3), dtype=np.uint8)
            cv2.imwrite(str(training / name / f"{number:06d}.png"), image)
        (training / "calib" / f"{number:06d}.txt").write_text(CALIBRATION.format(shift=-10), encoding="utf-8")
    return f"kitti-object:{tmp_path / 'drive'}"


def look(uri: str, **options: bool) -> list:
    with open_sequence(uri) as source, FrameHashes(source, **options) as hashes:
        return [hashes[index] for index in range(len(source))]


def test_remembered_hashes_are_those_of_the_decoded_frames(drive, cache_home, monkeypatch) -> None:
    first = look(drive)
    with open_sequence(drive) as source:
        assert [(item.chosen.pixels, item.chosen.geometry) for item in first] == [
            (pixel_hash(frame), geometry_hash(frame.geometry)) for frame in source
        ]

    def decode(self: ImagePairs, row: int, *, sequence: int) -> None:
        raise AssertionError("decoded")

    monkeypatch.setattr(ImagePairs, "_read", decode)
    again = look(drive)
    assert [item.chosen for item in again] == [item.chosen for item in first]
    assert [item.geometry.image_size_wh for item in again] == [(32, 16)] * 4
    with pytest.raises(AssertionError, match="decoded"):
        again[0].read()
    with pytest.raises(AssertionError, match="decoded"):
        look(drive, enabled=False)
    with pytest.raises(AssertionError, match="decoded"):  # one view alone is another frame
        look(f"{drive}?views=left")


def test_measured_frames_looked_at_before_are_compared_undecoded(drive, cache_home, monkeypatch) -> None:
    chosen = CalibrationSet("a drive", (look(drive)[2].chosen,), 4, "even")
    monkeypatch.setattr(ImagePairs, "_read", None)
    with open_sequence(drive) as source:
        assert overlap(chosen, source) == ("000002",)


def test_files_count_not_names(drive, cache_home, tmp_path) -> None:
    first = look(drive)
    training = tmp_path / "drive" / "training"
    (training / "image_3" / "000001.png").write_bytes((training / "image_3" / "000002.png").read_bytes())
    (training / "calib" / "000002.txt").write_text(CALIBRATION.format(shift=-12), encoding="utf-8")
    again = look(drive)
    assert [new.chosen.pixels == old.chosen.pixels for new, old in zip(again, first, strict=True)] == [
        True,
        False,
        True,
        True,
    ]
    assert [new.chosen.geometry == old.chosen.geometry for new, old in zip(again, first, strict=True)] == [
        True,
        True,
        False,
        True,
    ]
    assert pixel_hash(again[1].read()) == again[1].chosen.pixels


def test_a_view_that_cannot_be_read_is_named(drive, cache_home, tmp_path) -> None:
    with open_sequence(drive) as source:
        (tmp_path / "drive" / "training" / "image_3" / "000003.png").unlink()
        with FrameHashes(source) as hashes, pytest.raises(FrameError, match=r"000003\.png cannot be read"):
            hashes[3]
