"""What a source is: a context manager that iterates stereo frames; if file-backed, a sequence with labels."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

from runtime.contracts.errors import SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Objects3D
from runtime.sources.uri import SourceOptions

DEFAULT_CAMERA_HZ = 10.0
"""Rate where files name none; KITTI's."""


@runtime_checkable
class Source(Protocol):
    """Anything that yields frames.

    Attributes:
        uri: as it was asked for.
        is_live: frames come when the camera sends them and cannot be had again.
        arrives_at_camera_pace: the time between frames is that of the world, so that waiting is latency.
        frame_hz: frames a second of the world that the yielded frames stand for.
    """

    uri: str
    is_live: bool

    @property
    def arrives_at_camera_pace(self) -> bool: ...

    @property
    def frame_hz(self) -> float: ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def __iter__(self) -> Iterator[StereoFrame]: ...


class FrameSequence(ABC):
    """A file-backed source: frames by index, in any order, any number of times."""

    is_live = False

    def __init__(self, uri: str, *, count: int, options: SourceOptions, camera_hz: float = DEFAULT_CAMERA_HZ) -> None:
        """Chooses frames.

        Args:
            uri: for messages.
            count: frames on disk.
            options: which of them, and how.
            camera_hz: rate of the recording.

        Raises:
            SourceError: the options leave no frame.
        """
        self.uri = uri
        self.options = options
        self._camera_hz = camera_hz
        self._rows = options.rows(count, uri=uri)

    @property
    def arrives_at_camera_pace(self) -> bool:
        """Whether ``rate`` was asked for."""
        return self.options.rate is not None

    @property
    def frame_hz(self) -> float:
        """Rate of the yielded frames in the world's time."""
        rate = self.options.rate
        return rate if isinstance(rate, float) else self._camera_hz / self.options.step

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Lets go of open files."""
        self.close()

    def close(self) -> None:  # noqa: B027 - a folder of images has nothing to close
        """Lets go of open files."""

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, index: int) -> StereoFrame:
        """The frame, read now.

        Raises:
            FrameError: an image is missing, broken or of another size.
            FormatError: the calibration is wrong.
        """
        return self._read(self._rows[index], sequence=range(len(self))[index])

    def frame_id(self, index: int) -> str:
        """The name that results are filed under; reads no image."""
        return self._frame_id(self._rows[index])

    def labels(self, index: int) -> Objects3D | None:
        """Labelled objects of the frame, None where the source has no labels for it.

        Raises:
            FormatError: the label file is malformed.
        """
        return self._labels(self._rows[index])

    def __iter__(self) -> Iterator[StereoFrame]:
        """Frames in order; with ``rate`` at that pace, never faster, and none is left out."""
        due_secs = time.monotonic()
        before_secs: float | None = None
        for index in range(len(self)):
            frame = self[index]
            if self.options.rate is not None:
                if before_secs is not None:
                    due_secs = max(due_secs + self._interval_secs(before_secs, frame.timestamp_secs), time.monotonic())
                time.sleep(max(0.0, due_secs - time.monotonic()))
                before_secs = frame.timestamp_secs
            yield frame

    def _interval_secs(self, before_secs: float, now_secs: float) -> float:
        if self.options.rate == "camera" and now_secs > before_secs:
            return now_secs - before_secs
        return 1.0 / self.frame_hz

    @abstractmethod
    def _read(self, row: int, *, sequence: int) -> StereoFrame:
        """Frame number ``row`` of all that lie on disk."""

    @abstractmethod
    def _frame_id(self, row: int) -> str:
        """Its name."""

    def _labels(self, row: int) -> Objects3D | None:
        return None


def as_sequence(source: Source) -> FrameSequence:
    """The source as a sequence, for commands that need frames by index or labels.

    Raises:
        SourceError: it is live.
    """
    if isinstance(source, FrameSequence):
        return source
    raise SourceError(f"{source.uri} is live, expected recorded frames; record first or name a file-backed source")
