"""The frame loop: order, pairs, errors once, Ctrl-C, stale live frames."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import pytest

from runtime.contracts.errors import FrameError, OutputError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D
from runtime.detector import open_detector
from runtime.pipeline import JOIN_SECS, FrameReader, run_stream
from runtime.sinks.base import FrameResult
from runtime.sources.factory import open_source

P2 = np.array([[10.0, 0, 4, 0], [0, 10.0, 2, 0], [0, 0, 1, 0]])
GEOMETRY = StereoGeometry(P2, P2 - np.array([[0, 0, 0, 5.0], [0, 0, 0, 0], [0, 0, 0, 0]]), (8, 4))
NAMES = ("Car",)
DEPTH_TOLERANCE_M = 1e-4
"""Float32 network arithmetic on depths of some 20 m."""


def pair(number: int) -> StereoFrame:
    view = np.full((4, 8, 3), number % 256, np.uint8)
    return StereoFrame(view, view, number / 10, number, f"{number:06d}", GEOMETRY)


class Frames:
    """A source from a generator function."""

    uri = "test:"
    frame_hz = 10.0

    def __init__(
        self, make: Callable[[], Iterator[StereoFrame]], *, is_live: bool = False, paced: bool = False
    ) -> None:
        self._make = make
        self.is_live = is_live
        self.arrives_at_camera_pace = paced or is_live

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def __iter__(self) -> Iterator[StereoFrame]:
        return self._make()


class Collector:
    """A sink that remembers, and may fail at a frame."""

    def __init__(self, *, fail_at: int = -1, failure: BaseException | None = None) -> None:
        self.results: list[FrameResult] = []
        self._fail_at, self._failure = fail_at, failure

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def write(self, result: FrameResult) -> None:
        if len(self.results) == self._fail_at and self._failure is not None:
            raise self._failure
        self.results.append(result)

    def summary(self) -> str:
        return ""

    @property
    def sequences(self) -> list[int]:
        return [result.frame.sequence for result in self.results]


def nothing(frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
    return Detections3D.empty(NAMES), {"inference": 2.0}


def count_to(end: int) -> Callable[[], Iterator[StereoFrame]]:
    return lambda: (pair(number) for number in range(end))


def reader_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "frame-reader"]


def test_no_frame_at_all() -> None:
    report = run_stream(Frames(count_to(0)), nothing, [])
    assert (report.frames, report.frames_per_second, report.latency.summary()) == (0, 0.0, {})


@pytest.mark.parametrize("end", [1, 2, 3, 50])
def test_every_recorded_frame_in_order(end: int) -> None:
    sinks = [Collector(), Collector()]
    report = run_stream(Frames(count_to(end)), nothing, sinks)
    for sink in sinks:
        assert sink.sequences == list(range(end))
    assert (report.frames, report.dropped, report.interrupted) == (end, 0, False)
    assert report.latency.summary()["total"].count == end
    assert not reader_threads()


def test_a_slow_detector_loses_no_recorded_frame() -> None:
    def slow(frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
        time.sleep(0.01)
        return nothing(frame)

    sink = Collector()
    run_stream(Frames(count_to(12), paced=True), slow, [sink])
    assert sink.sequences == list(range(12))


def test_reading_overlaps_the_detector() -> None:
    def slow_frames() -> Iterator[StereoFrame]:
        for number in range(10):
            time.sleep(0.03)
            yield pair(number)

    def slow(frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
        time.sleep(0.03)
        return nothing(frame)

    report = run_stream(Frames(slow_frames), slow, [])
    assert report.elapsed_secs < 10 * 0.06 * 0.85


def test_stages_of_a_recording_add_up() -> None:
    sink = Collector()
    run_stream(Frames(count_to(3)), nothing, [sink])
    for result in sink.results:
        assert result.latency_ms["total"] == pytest.approx(result.latency_ms["read"] + 2.0)


def test_total_of_a_paced_source_counts_waiting() -> None:
    def slow(frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
        time.sleep(0.02)
        return nothing(frame)

    sink = Collector()
    run_stream(Frames(count_to(3), paced=True), slow, [sink])
    assert "read" not in sink.results[0].latency_ms
    assert all(result.latency_ms["total"] >= 19.0 for result in sink.results)
    assert sink.results[2].latency_ms["total"] > sink.results[0].latency_ms["total"]


def broken_after(good: int) -> Callable[[], Iterator[StereoFrame]]:
    def frames() -> Iterator[StereoFrame]:
        for number in range(good):
            yield pair(number)
        raise FrameError("frame 2 is broken")

    return frames


@pytest.mark.parametrize("good", [0, 2, 9])
def test_an_error_of_the_source_comes_after_the_frames_before_it(good: int) -> None:
    sink = Collector()
    with pytest.raises(FrameError, match="frame 2 is broken"):
        run_stream(Frames(broken_after(good)), nothing, [sink])
    assert sink.sequences == list(range(good))
    assert not reader_threads()


def test_an_error_of_a_sink_ends_the_run() -> None:
    sink = Collector(fail_at=3, failure=OutputError("disk full"))
    with pytest.raises(OutputError, match="disk full"):
        run_stream(Frames(count_to(1000)), nothing, [sink])
    assert sink.sequences == [0, 1, 2]
    assert not reader_threads()


def test_control_c_keeps_what_was_done() -> None:
    sink = Collector(fail_at=3, failure=KeyboardInterrupt())
    report = run_stream(Frames(count_to(1000)), nothing, [sink])
    assert report.interrupted
    assert report.frames == 3
    assert not reader_threads()


def test_stale_live_frames_are_dropped_and_counted() -> None:
    sent = 40

    def camera() -> Iterator[StereoFrame]:
        for number in range(sent):
            time.sleep(0.005)
            yield pair(number)

    def slow(frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
        time.sleep(0.03)
        return nothing(frame)

    sink = Collector()
    report = run_stream(Frames(camera, is_live=True), slow, [sink])
    assert report.dropped > 0
    assert report.dropped + report.frames == sent
    assert sink.sequences == sorted(set(sink.sequences))
    assert sink.sequences[-1] == sent - 1


def test_leaving_does_not_wait_for_a_silent_camera() -> None:
    release = threading.Event()

    def camera() -> Iterator[StereoFrame]:
        yield pair(0)
        release.wait(30)
        yield pair(1)

    began = time.monotonic()
    with FrameReader(Frames(camera, is_live=True)) as reader:
        assert next(iter(reader)).frame.sequence == 0
    assert time.monotonic() - began < JOIN_SECS + 1
    release.set()


def test_left_and_right_of_one_moment_stay_together(tiny_model: Path, tiny_drive: Path) -> None:
    """The tiny model's depth tells which right view it saw; labels and results belong to their frame."""
    sink = Collector()
    with open_source(f"kitti-object:{tiny_drive}") as source, open_detector(tiny_model) as detector:
        report = run_stream(source, detector, [sink], score=0.5, with_labels=True)
    assert report.detections == 4
    for number, result in enumerate(sink.results):
        depth_m = result.detections.center_in_camera[0, 2]
        assert depth_m == pytest.approx(20 + 10 * 40 * number / 255, abs=DEPTH_TOLERANCE_M)
        assert result.labels is not None
        assert len(result.labels) == 1
