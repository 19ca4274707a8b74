"""What a sink is: a context manager that takes results, one a frame, in order."""

from __future__ import annotations

from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Detections3D, Objects3D


@dataclass(frozen=True, slots=True)
class FrameResult:
    """All that is known of one frame.

    Attributes:
        frame: the pair that was looked at.
        detections: boxes found in it, at the stream's threshold.
        latency_ms: milliseconds by stage so far, ``total`` at the end.
        labels: true objects, None where there are none or nobody asked.
    """

    frame: StereoFrame
    detections: Detections3D
    latency_ms: dict[str, float]
    labels: Objects3D | None = None


class Sink(Protocol):
    """Somewhere that results go."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def write(self, result: FrameResult) -> None:
        """Take one frame's result.

        Raises:
            OutputError: it cannot be written.
        """

    def summary(self) -> str:
        """What was written where, in a few words."""
