"""JSON lines: one record a frame, written when the frame is done.

``{"frame_id", "timestamp_secs", "detections": [{"class", "score", "box2d", "center", "size_hwl", "yaw",
"alpha"}], "latency_ms": {stage: milliseconds}}``; box2d is x1 y1 x2 y2 in pixels of the left image, center
the middle of the box in metres of the camera frame (x right, y down, z forward), angles in radians.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

from runtime.contracts.errors import OutputError
from runtime.contracts.objects import Detections3D
from runtime.sinks.base import FrameResult
from runtime.sinks.places import claim_file

DECIMALS = 6
MILLISECOND_DECIMALS = 3
STANDARD_OUTPUT = "-"


class JsonLinesSink:
    """Writes to a file, or to standard output for ``-``."""

    def __init__(self, target: str, *, overwrite: bool = False) -> None:
        """Claims the file; it is opened on entering."""
        self._path = None if target == STANDARD_OUTPUT else claim_file(Path(target), overwrite=overwrite)
        self._stream: TextIO | None = None
        self._count = 0

    def __enter__(self) -> Self:
        """Opens the file.

        Raises:
            OutputError: it cannot be opened.
        """
        if self._path is None:
            self._stream = sys.stdout
            return self
        try:
            self._stream = self._path.open("w", encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"{self._path} cannot be written ({error.strerror}), expected a writable place; choose another"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Closes the file."""
        if self._stream is not None and self._path is not None:
            self._stream.close()
        self._stream = None

    def write(self, result: FrameResult) -> None:
        """One line, flushed, so that a reader at the other end of a pipe has it now."""
        if self._stream is None:
            raise OutputError("JSON lines: found a closed sink, expected an open one; enter it first")
        self._stream.write(json.dumps(record(result), separators=(", ", ": ")) + "\n")
        self._stream.flush()
        self._count += 1

    def summary(self) -> str:
        """What was written where."""
        return f"{self._count} records in {self._path or 'standard output'}"


def record(result: FrameResult) -> dict[str, Any]:
    """A result as JSON types."""
    return {
        "frame_id": result.frame.frame_id,
        "timestamp_secs": round(result.frame.timestamp_secs, DECIMALS),
        "detections": [_detection(result.detections, row) for row in range(len(result.detections))],
        "latency_ms": {stage: round(value, MILLISECOND_DECIMALS) for stage, value in result.latency_ms.items()},
    }


def _detection(detections: Detections3D, row: int) -> dict[str, Any]:
    def numbers(values: Any) -> list[float]:
        return [round(float(value), DECIMALS) for value in values]

    return {
        "class": detections.class_names[detections.class_id[row]],
        "score": round(float(detections.score[row]), DECIMALS),
        "box2d": numbers(detections.box_in_left_image[row]),
        "center": numbers(detections.center_in_camera[row]),
        "size_hwl": numbers(detections.size_hwl[row]),
        "yaw": round(float(detections.yaw_rad[row]), DECIMALS),
        "alpha": round(float(detections.alpha_rad[row]), DECIMALS),
    }
