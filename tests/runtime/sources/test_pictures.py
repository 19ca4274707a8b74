"""Image files: whole ones are read, damaged ones are refused, never half read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from runtime.contracts.errors import FrameError, SourceError
from runtime.sources.pictures import find_damage, list_images, locate_image, read_image

SUFFIXES = (".png", ".jpg", ".webp")
LOSSY_TOLERANCE = 12
"""Grey levels that JPEG and WebP may be off on a smooth picture."""


def smooth_picture() -> np.ndarray:
    rows, columns = np.mgrid[0:40, 0:60]
    return np.stack([rows * 3, columns * 2, rows + columns], axis=-1).astype(np.uint8)


def encoded(suffix: str) -> bytes:
    good, content = cv2.imencode(suffix, smooth_picture())
    assert good
    return content.tobytes()


def test_an_empty_file() -> None:
    assert find_damage(b"") == "it is empty"


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_whole_file_is_read(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    path.write_bytes(encoded(suffix))
    image = read_image(path, frame_id="a")
    assert image.shape == (40, 60, 3)
    assert image.dtype == np.uint8
    assert np.abs(image.astype(int) - smooth_picture()).mean() < LOSSY_TOLERANCE
    if suffix == ".png":
        assert np.array_equal(image, smooth_picture())


def test_a_grey_file_gets_three_channels(tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / "a.png"), smooth_picture()[..., 0])
    image = read_image(tmp_path / "a.png", frame_id="a")
    assert image.shape == (40, 60, 3)
    assert np.array_equal(image[..., 0], image[..., 2])


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=25, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
@given(share=st.floats(0.0, 0.99))
def test_a_file_cut_anywhere_is_refused(suffix: str, share: float, tmp_path: Path) -> None:
    content = encoded(suffix)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(FrameError, match="000007"):
        read_image(path, frame_id="000007")


@settings(max_examples=50, deadline=None)
@given(data=st.data())
def test_a_png_with_any_changed_byte_is_refused(data: st.DataObject) -> None:
    content = bytearray(encoded(".png"))
    position = data.draw(st.integers(8, len(content) - 1))
    content[position] ^= data.draw(st.integers(1, 255))
    assert find_damage(bytes(content)) is not None


@settings(max_examples=50, deadline=None)
@given(content=st.binary(max_size=200))
def test_random_bytes_never_crash(content: bytes) -> None:
    find_damage(content)
    for start in (b"\x89PNG\r\n\x1a\n", b"\xff\xd8", b"RIFF\x10\x00\x00\x00WEBP"):
        find_damage(start + content)


def test_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="cannot be read"):
        read_image(tmp_path / "a.png", frame_id="a")


def test_listing(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no folder"):
        list_images(tmp_path / "nowhere")
    with pytest.raises(SourceError, match="no image"):
        list_images(tmp_path)
    for name in ("b.jpg", "a.webp", "b.PNG", "notes.txt"):
        (tmp_path / name).touch()
    assert list(list_images(tmp_path)) == ["a", "b"]
    assert list_images(tmp_path)["b"].name == "b.PNG"
    assert locate_image(tmp_path, "a").name == "a.webp"
    assert locate_image(tmp_path, "z").name == "z.png"
