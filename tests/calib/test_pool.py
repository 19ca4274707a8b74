"""Looking at a bounded pool: what is read, remembered, and where objects come from."""

from __future__ import annotations

import numpy as np
import pytest

from calib import pool as pool_module
from calib.choice import choose
from calib.feature_cache import FeatureCache
from calib.pool import FOUND, LABELS, POOL_MOST, look_at, pool_size
from runtime.contracts.errors import FormatError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D

GEOMETRY = StereoGeometry(np.eye(3, 4), np.eye(3, 4), (32, 16))
EMPTY = Detections3D.empty(("Car",))


@pytest.fixture(autouse=True)
def cache_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Drive:
    """Frames by index, ever brighter; counts what is read."""

    def __init__(self, count: int) -> None:
        self.count = count
        self.read: list[int] = []

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> StereoFrame:
        self.read.append(index)
        image = np.full((16, 32, 3), index % 251, np.uint8)
        image[0, 0] = index // 251
        return StereoFrame(image, image, 0.0, index, f"{index:06d}", GEOMETRY)


class LabelledDrive(Drive):
    """With labels, but for the frames in ``without``."""

    def __init__(self, count: int, *, without: tuple[int, ...] = (), broken: bool = False) -> None:
        super().__init__(count)
        self.without, self.broken = without, broken

    def labels(self, index: int) -> Detections3D | None:
        if self.broken:
            raise FormatError("label file: broken")
        return None if index in self.without else EMPTY


class Finder:
    """Finds nothing, and counts."""

    identity = "toy"

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, frame: StereoFrame) -> Detections3D:
        self.calls += 1
        return EMPTY


@pytest.mark.parametrize(
    ("wanted", "available", "size"),
    [(1, 5, 5), (1, 1000, 60), (50, 1000, 150), (200, 100_000, POOL_MOST), (500, 100_000, 500), (500, 400, 400)],
)
def test_the_pool_is_bounded(wanted, available, size) -> None:
    assert pool_size(wanted, available) == size


def test_few_frames_of_a_long_drive_are_read_and_spread() -> None:
    drive = Drive(5000)
    pool = look_at(drive, 10)
    assert len(drive.read) == len(pool.frames) == 60
    assert max(np.diff(drive.read)) <= 84  # 5000 / 60, and one for rounding
    assert pool.between.shape == (60, 60)


def test_objects_are_labels_else_found_else_left_out() -> None:
    finder = Finder()
    assert not any("(" in name for name in look_at(Drive(8), 2).looked_at)
    assert any(LABELS in name for name in look_at(LabelledDrive(8), 2, find=finder).looked_at)
    assert finder.calls == 0
    assert any(FOUND in name for name in look_at(LabelledDrive(8, without=(3,)), 2, find=finder).looked_at)
    assert finder.calls == 8


def test_broken_labels_are_said_and_not_used() -> None:
    told: list[str] = []
    looked_at = look_at(LabelledDrive(4, broken=True), 2, warn=told.append).looked_at
    assert not any(LABELS in name for name in looked_at)
    assert told == ["the choice of calibration frames goes without labels: label file: broken"]


def test_a_pool_is_looked_at_once(monkeypatch, cache_home) -> None:
    finder = Finder()
    first = look_at(Drive(8), 2, find=finder)

    def computed(frame: StereoFrame) -> None:
        raise AssertionError("was remembered")

    monkeypatch.setattr(pool_module.scene_features, "scene_row", computed)
    again = look_at(Drive(8), 2, find=finder)
    assert finder.calls == 8
    np.testing.assert_array_equal(again.between, first.between)
    assert not list(cache_home.rglob("*.tmp"))
    with pytest.raises(AssertionError, match="was remembered"):
        look_at(Drive(8), 2, use_cache=False)


def test_without_the_cache_nothing_is_written(cache_home) -> None:
    look_at(Drive(4), 2, find=Finder(), use_cache=False)
    assert not cache_home.exists()


def test_a_damaged_cache_counts_as_absent(cache_home) -> None:
    with FeatureCache("toy") as cache:
        cache.put("a", np.ones(3, np.float32))
    (path,) = cache_home.rglob("*.npz")
    with FeatureCache("toy") as cache:
        np.testing.assert_array_equal(cache.get("a", size=3), np.ones(3, np.float32))
        assert cache.get("a", size=4) is None
        assert cache.get("b", size=3) is None
    whole = path.read_bytes()
    torn = whole[:64] + bytes(255 - byte for byte in whole[64:96]) + whole[96:]  # within the first packed array
    for damage in (whole[:40], torn):
        path.write_bytes(damage)
        with FeatureCache("toy") as cache:
            assert cache.get("a", size=3) is None


def test_the_choice_covers_better_than_even_spread_and_repeats() -> None:
    """Ninety frames alike and ten that differ, between them: even spread sees few of these."""

    class Odd(Drive):
        def __getitem__(self, index: int) -> StereoFrame:
            bright = index in range(41, 51)
            image = np.full((16, 32, 3), 20 * (index - 40) if bright else 30 + index % 2, np.uint8)
            return StereoFrame(image, image, 0.0, index, f"{index:06d}", GEOMETRY)

    chosen = choose(Odd(100), 5, name="odd").chosen
    assert chosen.coverage.pool == 60
    assert chosen.coverage.score > chosen.coverage.even_score + 0.1
    assert choose(Odd(100), 5, name="odd").chosen == chosen
    assert sum(frame.index in range(41, 51) for frame in chosen.frames) >= 2
