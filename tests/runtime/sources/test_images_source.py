"""Image pairs from file patterns."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.contracts.errors import FormatError, FrameError, SourceError
from runtime.contracts.geometry import StereoGeometry
from runtime.rig import format_geometry
from runtime.sources.base import as_sequence
from runtime.sources.factory import open_source


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    left = np.array([[100.0, 0, 32, 0], [0, 100.0, 16, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -50.0
    (tmp_path / "rig.json").write_text(format_geometry(StereoGeometry(left, right, (64, 32))), encoding="utf-8")
    return tmp_path


def write(folder: Path, *names: str, grey: int = 0, size_wh: tuple[int, int] = (64, 32)) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), np.full((size_wh[1], size_wh[0], 3), grey, np.uint8))


def uri(folder: Path, left: str, right: str) -> str:
    return f"images:{folder}/{left},{folder}/{right}?geometry={folder}/rig.json"


def test_nothing_to_find(folder: Path) -> None:
    with pytest.raises(SourceError, match="finds no image"):
        open_source(uri(folder, "l/*", "r/*"))


def test_pairs_by_stem_whatever_the_kind(folder: Path) -> None:
    write(folder, "l/b.png", "l/a.jpg", grey=10)
    write(folder, "r/a.png", "r/b.webp", grey=20)
    with as_sequence(open_source(uri(folder, "l/*", "r"))) as source:
        assert [frame.frame_id for frame in source] == ["a", "b"]


def test_pairs_by_order_where_no_name_is_common(folder: Path) -> None:
    write(folder, "left_1.png", "left_2.png")
    write(folder, "right_1.png", grey=1)
    write(folder, "right_2.png", grey=2)
    with as_sequence(open_source(uri(folder, "left_?.png", "right_?.png"))) as source:
        assert [source[index].right[0, 0, 0] for index in range(2)] == [1, 2]  # type: ignore[index]


def test_unequal_counts_without_common_names(folder: Path) -> None:
    write(folder, "left_1.png", "left_2.png", "right_1.png")
    with pytest.raises(SourceError, match="2 left and 1 right"):
        open_source(uri(folder, "left_?.png", "right_?.png"))


@pytest.mark.parametrize(("extra", "side"), [("l/c.png", "right"), ("r/c.png", "left")])
def test_a_lonely_image(folder: Path, extra: str, side: str) -> None:
    write(folder, "l/a.png", "r/a.png", extra)
    with pytest.raises(FrameError, match=f"frame c: found no {side} image"):
        open_source(uri(folder, "l/*", "r/*"))


def test_equal_names_in_many_folders_pair_by_order(folder: Path) -> None:
    write(folder, "l/1/a.png", "l/2/a.png")
    write(folder, "r/1/a.png", grey=1)
    write(folder, "r/2/a.png", grey=2)
    with as_sequence(open_source(uri(folder, "l/**/*.png", "r/**/*.png"))) as source:
        assert [frame.frame_id for frame in source] == ["000000", "000001"]
        assert [source[index].right[0, 0, 0] for index in range(2)] == [1, 2]  # type: ignore[index]


def test_names_that_repeat_must_agree_in_order(folder: Path) -> None:
    write(folder, "l/1/a.png", "l/1/b.png", "l/2/a.png", "r/1/a.png", "r/2/a.png", "r/2/b.png")
    with pytest.raises(FrameError, match=r"l/1/b\.png beside .*r/2/a\.png"):
        open_source(uri(folder, "l/**/*.png", "r/**/*.png"))


def test_one_view(folder: Path) -> None:
    write(folder, "l/a.png")
    with open_source(f"images:{folder}/l?views=left&geometry={folder}/rig.json") as source:
        assert [frame.right for frame in source] == [None]


def test_half_size_images_get_half_the_focal_length(folder: Path) -> None:
    write(folder, "l/a.png", "r/a.png", size_wh=(32, 16))
    with as_sequence(open_source(uri(folder, "l", "r"))) as source:
        assert source[0].geometry.focal_px == 50.0
        assert source[0].geometry.baseline_m == 0.5


def test_images_of_another_shape(folder: Path) -> None:
    write(folder, "l/a.png", "r/a.png", size_wh=(64, 20))
    with as_sequence(open_source(uri(folder, "l", "r"))) as source, pytest.raises(FormatError, match="64x20"):
        source[0]


@pytest.mark.parametrize(("broken", "told"), [(("r",), "r/a.png"), (("l",), "l/a.png"), (("l", "r"), "l/a.png")])
def test_a_broken_view_is_named_though_both_are_read_at_once(folder: Path, broken: tuple[str, ...], told: str) -> None:
    write(folder, "l/a.png", "r/a.png")
    for side in broken:
        path = folder / side / "a.png"
        path.write_bytes(path.read_bytes()[:-20])
    source = as_sequence(open_source(uri(folder, "l/*", "r/*")))
    with source, pytest.raises(FrameError, match=f"{told} is broken"):
        source[0]
