"""OpenCV without its own log: what goes wrong is told by our errors, once."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

import cv2

_SILENT = cv2.utils.logging.LOG_LEVEL_SILENT
_FFMPEG_LEVEL, _FFMPEG_QUIET = "OPENCV_FFMPEG_LOGLEVEL", "-8"


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silences OpenCV's log inside the block; process-wide, as the log is."""
    os.environ.setdefault(_FFMPEG_LEVEL, _FFMPEG_QUIET)  # read when the first video is opened
    before = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(_SILENT)
    try:
        yield
    finally:
        cv2.utils.logging.setLogLevel(before)
