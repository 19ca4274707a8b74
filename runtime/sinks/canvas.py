"""Overlay pictures to a video file or a folder of images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import OutputError
from runtime.quiet import quiet_opencv
from runtime.sinks.base import FrameResult
from runtime.sinks.overlay import OverlayRenderer
from runtime.sinks.places import claim_file, claim_folder

CODEC_OF_SUFFIX = {".mp4": "mp4v", ".avi": "MJPG", ".mkv": "mp4v", ".webm": "VP90"}
LEAST_FPS = 1.0
PICTURE_SUFFIX = ".jpg"
PICTURE_QUALITY = 92

Image = NDArray[np.uint8]


class CanvasWriter(Protocol):
    """Takes finished pictures."""

    def write(self, canvas: Image, frame_id: str) -> None:
        """Take one picture."""

    def close(self) -> None:
        """Finish the file."""

    def summary(self) -> str:
        """What was written where."""


class OverlaySink:
    """Draws each result once and hands the picture to all writers."""

    def __init__(self, renderer: OverlayRenderer, writers: Sequence[CanvasWriter]) -> None:
        """Takes at least one writer."""
        self._renderer = renderer
        self._writers = writers

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Finishes the files."""
        for writer in self._writers:
            writer.close()

    def write(self, result: FrameResult) -> None:
        """Draws and writes.

        Raises:
            OutputError: a picture cannot be written.
        """
        canvas = self._renderer.draw(result)
        for writer in self._writers:
            writer.write(canvas, result.frame.frame_id)

    def summary(self) -> str:
        """What was written where."""
        return "; ".join(writer.summary() for writer in self._writers)


class VideoFile:
    """A video; codec by the file's ending."""

    def __init__(self, path: Path | str, *, fps: float, overwrite: bool = False) -> None:
        """Claims the file; the writer opens with the first picture, whose size it takes.

        Raises:
            OutputError: the ending is of no known kind, or the file exists.
        """
        self._path = Path(path)
        codec = CODEC_OF_SUFFIX.get(self._path.suffix.lower())
        if codec is None:
            raise OutputError(
                f"{path} ends in {self._path.suffix or 'nothing'}, expected {', '.join(CODEC_OF_SUFFIX)}; rename it"
            )
        claim_file(self._path, overwrite=overwrite)
        self._fourcc = cv2.VideoWriter.fourcc(*codec)
        self._fps = max(fps, LEAST_FPS)
        self._writer: cv2.VideoWriter | None = None
        self._count = 0

    def write(self, canvas: Image, frame_id: str) -> None:
        """One frame more."""
        if self._writer is None:
            size_wh = (canvas.shape[1], canvas.shape[0])
            with quiet_opencv():
                self._writer = cv2.VideoWriter(str(self._path), cv2.CAP_FFMPEG, self._fourcc, self._fps, size_wh)
            if not self._writer.isOpened():
                raise OutputError(
                    f"{self._path} cannot be opened for video, expected a writable place and OpenCV's codec "
                    f"for {self._path.suffix}; try another ending: {', '.join(CODEC_OF_SUFFIX)}"
                )
        self._writer.write(canvas)
        self._count += 1

    def close(self) -> None:
        """Finish the file; without it, players refuse it."""
        if self._writer is not None:
            self._writer.release()
            self._writer = None

    def summary(self) -> str:
        """What was written where."""
        return f"{self._count} video frames in {self._path}"


class PictureFolder:
    """A folder of JPEG pictures, named by frame; a slash in the frame id makes a folder."""

    def __init__(self, folder: Path | str, *, overwrite: bool = False) -> None:
        """Claims the folder."""
        self._folder = claim_folder(Path(folder), overwrite=overwrite)
        self._count = 0

    def write(self, canvas: Image, frame_id: str) -> None:
        """One picture more.

        Raises:
            OutputError: it cannot be written.
        """
        path = self._folder / f"{frame_id}{PICTURE_SUFFIX}"
        _, content = cv2.imencode(PICTURE_SUFFIX, canvas, [cv2.IMWRITE_JPEG_QUALITY, PICTURE_QUALITY])
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.tobytes())
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({error.strerror}), expected a writable place; choose another"
            ) from error
        self._count += 1

    def close(self) -> None:
        """Each picture is finished already."""

    def summary(self) -> str:
        """What was written where."""
        return f"{self._count} pictures in {self._folder}"
