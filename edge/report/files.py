"""Writes result files: beside their place first, then renamed, so that a reader never sees half of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import OutputError

JPEG_QUALITY = 90


def write_json(path: Path, record: Any) -> None:
    """Write a record as JSON.

    Raises:
        OutputError: the place cannot be written.
    """
    write_text(path, json.dumps(record, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write text.

    Raises:
        OutputError: the place cannot be written.
    """
    _write(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write content as it is.

    Raises:
        OutputError: the place cannot be written.
    """
    _write(path, content)


def write_picture(path: Path, image: NDArray[np.uint8]) -> None:
    """Write a picture, (H, W, 3) uint8 BGR, as JPEG.

    Raises:
        OutputError: the place cannot be written.
    """
    _, content = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    _write(path, content.tobytes())


def _write(path: Path, content: bytes) -> None:
    beside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(content)
        beside.replace(path)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise OutputError(f"{path} cannot be written ({reason}), expected a writable place; choose another") from None
