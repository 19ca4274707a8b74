"""The frame loop: source, detector, sinks, always whole pairs.

One thread reads ahead, so that the next pair is decoded while the model works on this one; a short queue
bounds what lies between. Recorded frames are never dropped. A live camera's frames are taken newest first:
one that was not fetched before the next came is stale, dropped, and counted.
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from types import TracebackType
from typing import Self

from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.latency import LatencyLog
from runtime.sinks.base import FrameResult, Sink
from runtime.sources.base import FrameSequence, Source

READ_AHEAD_FRAMES = 2
JOIN_SECS = 2.0
_POLL_SECS = 0.05

FrameDetector = Callable[..., tuple[Detections3D, dict[str, float]]]
"""``(frame, score=...) -> (boxes, milliseconds by stage)``; `runtime.detector.Detector` is one."""


@dataclass(frozen=True, slots=True)
class ReadFrame:
    """A frame with what reading it took.

    Attributes:
        frame: the pair; labels: its true objects where they were asked for; read_ms: time to read and decode
            it;
        arrived_secs: when it was ready, on the monotonic clock.
    """

    frame: StereoFrame
    labels: Objects3D | None
    read_ms: float
    arrived_secs: float


@dataclass(slots=True)
class StreamReport:
    """What a run came to.

    Attributes:
        frames: results handed to the sinks; detections: boxes in them; dropped: stale live frames;
            elapsed_secs: from
        the first request to the last result; interrupted: the user stopped it; latency: by stage.
    """

    frames: int = 0
    detections: int = 0
    dropped: int = 0
    elapsed_secs: float = 0.0
    interrupted: bool = False
    latency: LatencyLog = field(default_factory=LatencyLog)

    @property
    def frames_per_second(self) -> float:
        """Throughput of the whole loop."""
        return self.frames / self.elapsed_secs if self.elapsed_secs > 0 else 0.0


def run_stream(
    source: Source,
    detector: FrameDetector,
    sinks: Sequence[Sink],
    *,
    score: float | None = None,
    with_labels: bool = False,
    on_result: Callable[[FrameResult], None] | None = None,
) -> StreamReport:
    """Looks at every frame of an entered source and hands the results to entered sinks.

    Latency by stage, in milliseconds: ``read`` (file to pixels, in a thread beside the model; left out where it would
    include waiting for a camera), the detector's own stages, ``write`` (all sinks), and ``total``: where frames come at
    a camera's pace, from a frame's arrival to its result, waiting included; where they are read as fast as they are
    used up, the sum of the stages.

    Args:
        source: an entered source.
        detector: as `FrameDetector`.
        sinks: entered sinks.
        score: least score, handed to the detector.
        with_labels: hand labels of file-backed sources to the sinks.
        on_result: is shown each result, for progress.

    Returns:
        The report; after Ctrl-C that of the frames until then.

    Raises:
        EdgeError: whatever source, detector or a sink raised, once.
    """
    report = StreamReport()
    paced = source.arrives_at_camera_pace
    began_secs = time.monotonic()
    reader = FrameReader(source, with_labels=with_labels)
    try:
        with reader:
            for item in reader:
                result, stages = _look_at(item, detector, score=score, paced=paced)
                started_secs = time.monotonic()
                for sink in sinks:
                    sink.write(result)
                finished_secs = time.monotonic()
                stages["write"] = 1e3 * (finished_secs - started_secs)
                since_arrival_ms = 1e3 * (finished_secs - item.arrived_secs)
                total_ms = since_arrival_ms if paced else sum(stages.values())
                report.latency.add({**stages, "total": total_ms})
                report.frames += 1
                report.detections += len(result.detections)
                report.elapsed_secs = finished_secs - began_secs
                if on_result is not None:
                    on_result(result)
    except KeyboardInterrupt:
        report.interrupted = True
    report.dropped = reader.dropped
    return report


def _look_at(
    item: ReadFrame, detector: FrameDetector, *, score: float | None, paced: bool
) -> tuple[FrameResult, dict[str, float]]:
    detections, detector_ms = detector(item.frame, score=score)
    stages = detector_ms if paced else {"read": item.read_ms, **detector_ms}
    waited_ms = 1e3 * (time.monotonic() - item.arrived_secs)
    so_far = {**stages, "total": waited_ms if paced else sum(stages.values())}
    return FrameResult(item.frame, detections, so_far, item.labels), stages


class FrameReader:
    """Reads a source in a thread of its own; iterating gives the frames in order.

    Attributes:
        dropped: stale frames of a live source so far.
    """

    def __init__(self, source: Source, *, with_labels: bool = False) -> None:
        """Prepares to read an entered source."""
        self.dropped = 0
        self._source = source
        self._sequence = source if with_labels and isinstance(source, FrameSequence) else None
        self._queue: queue.Queue[ReadFrame | None] = queue.Queue(1 if source.is_live else READ_AHEAD_FRAMES)
        self._failure: BaseException | None = None
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="frame-reader", daemon=True)

    def __enter__(self) -> Self:
        """Starts reading."""
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops reading; a camera that is silent just then may keep the thread a little longer."""
        self._stop.set()
        self._thread.join(JOIN_SECS)

    def __iter__(self) -> Iterator[ReadFrame]:
        """Frames until the source ends.

        Raises:
            EdgeError: what the source raised, after the frames before it.
        """
        while (item := self._queue.get()) is not None:
            yield item
        if self._failure is not None:
            raise self._failure

    def _read(self) -> None:
        try:
            frames = iter(self._source)
            while not self._stop.is_set():
                asked_secs = time.monotonic()
                frame = next(frames, None)
                if frame is None:
                    break
                self._put(self._with_labels(frame, asked_secs))
        except BaseException as error:  # handed to the loop, which raises it
            self._failure = error
        self._put(None)

    def _with_labels(self, frame: StereoFrame, asked_secs: float) -> ReadFrame:
        labels = None if self._sequence is None else self._sequence.labels(frame.sequence)
        arrived_secs = time.monotonic()
        return ReadFrame(frame, labels, 1e3 * (arrived_secs - asked_secs), arrived_secs)

    def _put(self, item: ReadFrame | None) -> None:
        while not self._stop.is_set():
            try:
                self._queue.put(item, timeout=0 if self._source.is_live and item else _POLL_SECS)
                return
            except queue.Full:
                if self._source.is_live and item is not None:
                    self._drop_stale()

    def _drop_stale(self) -> None:
        try:
            self._queue.get_nowait()
        except queue.Empty:
            return
        self.dropped += 1
