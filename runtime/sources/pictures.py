"""Image files: find them in a folder, read one whole or say what is wrong with it.

Decoders answer a damaged file with a half-grey picture and no error, so the container is checked first:
every PNG chunk's checksum, JPEG's end marker, WebP's length.
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError, SourceError
from runtime.quiet import quiet_opencv

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp")
"""In order of preference where one stem has several files."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_JPEG_TAIL_BYTES = 4096
_COLOUR = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # turned pixels would not fit the calibration


def list_images(folder: Path) -> dict[str, Path]:
    """Image files of a folder by stem, sorted by stem.

    Raises:
        SourceError: there is no such folder, or no image in it.
    """
    if not folder.is_dir():
        raise SourceError(f"found no folder {folder}, expected images in it; check the path and the layout")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir(), key=lambda item: _preference(item.suffix)):
        if path.suffix.lower() in IMAGE_SUFFIXES:
            found.setdefault(path.stem, path)
    if not found:
        raise SourceError(f"{folder} holds no image, expected {', '.join(IMAGE_SUFFIXES)}; check the path")
    return {stem: found[stem] for stem in sorted(found)}


def locate_image(folder: Path, stem: str) -> Path:
    """The image of this stem; where there is none, the PNG that would be expected."""
    paths = [folder / f"{stem}{suffix}" for suffix in IMAGE_SUFFIXES]
    return next((path for path in paths if path.is_file()), paths[0])


def read_image(path: Path, *, frame_id: str) -> NDArray[np.uint8]:
    """One image in colour.

    Args:
        path: PNG, JPEG or WebP file.
        frame_id: for messages.

    Returns:
        (H, W, 3) uint8 BGR; a grey image gets three equal channels.

    Raises:
        FrameError: the file is missing, damaged, cut short or no image.
    """
    content = read_content(path, frame_id=frame_id)
    damage = find_damage(content)
    image = None if damage else _decode(content)
    if image is None:
        raise FrameError(
            f"frame {frame_id}: {path} is broken ({damage or 'it cannot be decoded'}), expected a whole "
            "PNG, JPEG or WebP image; copy it again"
        )
    return image


def read_content(path: Path, *, frame_id: str) -> bytes:
    """An image file as it lies on disk.

    Args:
        path: Any file.
        frame_id: for messages.

    Raises:
        FrameError: the file cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise FrameError(
            f"frame {frame_id}: {path} cannot be read ({error.strerror}), expected an image; restore the file"
        ) from error


def _decode(content: bytes) -> NDArray[np.uint8] | None:
    with quiet_opencv():
        image = cv2.imdecode(np.frombuffer(content, np.uint8), _COLOUR)
    return None if image is None else image.astype(np.uint8, copy=False)


def find_damage(content: bytes) -> str | None:
    """What is wrong with an image file's container, None where nothing is."""
    if not content:
        return "it is empty"
    if content.startswith(_PNG_SIGNATURE):
        return _png_damage(content)
    if content.startswith(_JPEG_START):
        return None if _JPEG_END in content[-_JPEG_TAIL_BYTES:] else "the JPEG is cut short"
    if content[:4] == b"RIFF" and content[8:12] == b"WEBP":
        whole = len(content) >= 8 + struct.unpack("<I", content[4:8])[0]
        return None if whole else "the WebP is cut short"
    return "it is none of PNG, JPEG, WebP"


def _png_damage(content: bytes) -> str | None:
    """Walks the chunks: length, type, data, CRC of type and data (PNG specification, chunk layout)."""
    view = memoryview(content)
    at = len(_PNG_SIGNATURE)
    while at + 12 <= len(content):
        (length,) = struct.unpack(">I", view[at : at + 4])
        end = at + 12 + length
        if end > len(content):
            break
        if zlib.crc32(view[at + 4 : end - 4]) != struct.unpack(">I", view[end - 4 : end])[0]:
            return "a PNG checksum differs"
        if content[at + 4 : at + 8] == b"IEND":
            return None
        at = end
    return "the PNG is cut short"


def _preference(suffix: str) -> int:
    known = suffix.lower()
    return IMAGE_SUFFIXES.index(known) if known in IMAGE_SUFFIXES else len(IMAGE_SUFFIXES)
