"""``video:LEFT,RIGHT?geometry=FILE`` or ``video:FILE?layout=side-by-side&geometry=FILE``: recorded,
rectified video.

Two files are read in step, frame n with frame n. With ``views=left`` one file is the left view.
"""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.quiet import quiet_opencv
from runtime.rig import load_geometry
from runtime.sources.base import DEFAULT_CAMERA_HZ, FrameSequence
from runtime.sources.images import geometry_option, split_target
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ("geometry", "layout")
SIDE_BY_SIDE = "side-by-side"
_UNCOUNTED = (".webm", ".mkv")
"""Kinds that do not say how many frames they hold; OpenCV would guess from the length in seconds."""


def open_video(uri: SourceUri, options: SourceOptions) -> VideoPairs:
    """The frames of one or two video files.

    Raises:
        SourceError: a file or the geometry is missing, a file is no video, the two differ in length.
    """
    layout = uri.options.get("layout")
    if layout not in (None, SIDE_BY_SIDE):
        raise SourceError(f"{uri.text}: layout={layout}, expected {SIDE_BY_SIDE} or no layout; mend the URI")
    geometry = geometry_option(uri)
    if layout == SIDE_BY_SIDE:
        if "," in uri.target or not uri.target:
            raise SourceError(f"{uri.text}: found {uri.target!r}, expected one file that shows both views; name it")
        names = [uri.target]
    else:
        names = split_target(uri, options, form="video:LEFT,RIGHT or video:FILE?layout=side-by-side")
    paths = [Path(name) for name in names]
    return VideoPairs(uri.text, paths, options=options, geometry=geometry, side_by_side=layout == SIDE_BY_SIDE)


class VideoPairs(FrameSequence):
    """Frames of video files; a step back in time starts the file again."""

    def __init__(
        self, uri: str, paths: list[Path], *, options: SourceOptions, geometry: Path, side_by_side: bool
    ) -> None:
        """Opens one file (both views side by side, or the left alone) or two."""
        self._side_by_side = side_by_side
        self._readers = [_Reader(path, uri=uri) for path in (paths[:1] if options.views == "left" else paths)]
        counts = [reader.count for reader in self._readers]
        if len(set(counts)) > 1:
            self.close()
            raise SourceError(
                f"{uri}: left has {counts[0]} frames and right {counts[1]}, expected the same; cut them to one length"
            )
        self._geometry_file = geometry
        self._geometry: StereoGeometry | None = None
        super().__init__(uri, count=counts[0], options=options, camera_hz=self._readers[0].hz)

    def close(self) -> None:
        """Closes the files."""
        for reader in self._readers:
            reader.close()

    def _read(self, row: int, *, sequence: int) -> StereoFrame:
        name = self._frame_id(row)
        images = [reader.read(row, frame_id=name) for reader in self._readers]
        if self._side_by_side:
            images = _halves(images[0], frame_id=name)
        left, right = images[0], None if self.options.views == "left" else images[1]
        if self._geometry is None:
            self._geometry = load_geometry(self._geometry_file, (left.shape[1], left.shape[0]))
        return StereoFrame(
            left=left,
            right=right,
            timestamp_secs=row / self._camera_hz,
            sequence=sequence,
            frame_id=name,
            geometry=self._geometry,
        )

    def _frame_id(self, row: int) -> str:
        return f"{row:06d}"


def _halves(image: NDArray[np.uint8], *, frame_id: str) -> list[NDArray[np.uint8]]:
    width = image.shape[1]
    if width % 2:
        raise FrameError(
            f"frame {frame_id}: the image is {width} columns wide, expected an even width for two views "
            "side by side; check the layout"
        )
    return [np.ascontiguousarray(image[:, : width // 2]), np.ascontiguousarray(image[:, width // 2 :])]


class _Reader:
    """One video file, read forwards; another thread may close it, which ends a reading within a frame."""

    def __init__(self, path: Path, *, uri: str) -> None:
        if not path.is_file():
            raise SourceError(f"{uri}: found no file {path}, expected a video; check the path")
        self._path = path
        with quiet_opencv():
            self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        self._lock = threading.Lock()
        self._next = 0
        self.count = self._count_frames() if self._capture.isOpened() else 0
        if self.count < 1:
            self.close()
            raise SourceError(f"{uri}: {path} is no video that can be read, expected MP4, AVI or WebM; convert it")
        self.hz = float(self._capture.get(cv2.CAP_PROP_FPS)) or DEFAULT_CAMERA_HZ

    def read(self, row: int, *, frame_id: str) -> NDArray[np.uint8]:
        if row < self._next:
            self._rewind()
        while self._next <= row and self._grab():
            pass
        image = self._grabbed() if self._next == row + 1 else None
        if image is None:
            raise FrameError(
                f"frame {frame_id}: {self._path} ends at frame {self._next}, expected {self.count}; "
                "the file is cut short: copy it again or set limit"
            )
        pixels: NDArray[np.uint8] = image.astype(np.uint8, copy=False)
        return pixels

    def close(self) -> None:
        with self._lock:
            self._capture.release()

    def _count_frames(self) -> int:
        if self._path.suffix.lower() not in _UNCOUNTED:
            return int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        while self._grab():
            pass
        count = self._next
        self._rewind()
        return count

    def _rewind(self) -> None:
        with self._lock:
            if self._capture.isOpened():
                self._capture.open(str(self._path), cv2.CAP_FFMPEG)
        self._next = 0

    def _grab(self) -> bool:
        with self._lock:
            good = self._capture.grab()
        self._next += good
        return good

    def _grabbed(self) -> cv2.typing.MatLike | None:
        with self._lock:
            good, image = self._capture.retrieve()
        return image if good else None
