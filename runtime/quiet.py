"""OpenCV without its own log: what goes wrong is told by our errors, once."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import cv2

_log: Any = cv2.utils.logging if hasattr(cv2.utils, "logging") else cv2  # where OpenCV 5 and 4 keep the functions
_SILENT = 0
_FFMPEG_LEVEL, _FFMPEG_QUIET = "OPENCV_FFMPEG_LOGLEVEL", "-8"


class _Quiet:
    """How many blocks want silence now, whatever thread they run in, and the log level from before the first."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._blocks = 0
        self._before = 0

    def begin(self) -> None:
        with self._lock:
            if self._blocks == 0:
                self._before = _log.getLogLevel()
                _log.setLogLevel(_SILENT)
            self._blocks += 1

    def end(self) -> None:
        with self._lock:
            self._blocks -= 1
            if self._blocks == 0:
                _log.setLogLevel(self._before)


_quiet = _Quiet()


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silences OpenCV's log inside the block; process-wide, as the log is, until the last of several blocks ends."""
    os.environ.setdefault(_FFMPEG_LEVEL, _FFMPEG_QUIET)  # read when the first video is opened
    _quiet.begin()
    try:
        yield
    finally:
        _quiet.end()
