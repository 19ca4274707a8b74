"""OpenCV without its own log: what goes wrong is told by our errors, once."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2

_log: Any = cv2.utils.logging if hasattr(cv2.utils, "logging") else cv2  # where OpenCV 5 and 4 keep the functions
_SILENT = 0
_FFMPEG_LEVEL, _FFMPEG_QUIET = "OPENCV_FFMPEG_LOGLEVEL", "-8"


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silences OpenCV's log inside the block; process-wide, as the log is."""
    os.environ.setdefault(_FFMPEG_LEVEL, _FFMPEG_QUIET)  # read when the first video is opened
    before = _log.getLogLevel()
    _log.setLogLevel(_SILENT)
    try:
        yield
    finally:
        _log.setLogLevel(before)
