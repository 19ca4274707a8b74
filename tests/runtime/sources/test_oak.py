"""The OAK source without a camera: its pure part, and depthai's host-only pipeline through the real pairing node."""

from __future__ import annotations

import time
from datetime import timedelta
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from runtime.contracts.errors import FormatError, FrameError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.depthai_rig import rectified_geometry
from runtime.sources import oak
from runtime.sources.factory import open_source
from runtime.sources.oak_frames import CameraMessage, choose, to_frame
from runtime.sources.uri import SourceOptions

GEOMETRY = rectified_geometry(np.array([[800.0, 0, 64], [0, 800.0, 20], [0, 0, 1]]), 0.075, (128, 40))


def message(grey: int = 5, *, at_secs: float = 1.0, size_hw: tuple[int, ...] = (40, 128)) -> CameraMessage:
    return CameraMessage(np.full(size_hw, grey, np.uint8), at_secs, 17)


def test_a_frame_keeps_time_and_number() -> None:
    frame = to_frame(message(5), message(6, at_secs=1.01), geometry=GEOMETRY, tolerance_secs=0.05)
    assert (frame.timestamp_secs, frame.sequence, frame.frame_id) == (1.0, 17, "000017")
    assert frame.left.shape == (40, 128, 3)
    assert frame.right is not None
    assert (frame.left[0, 0].tolist(), frame.right[0, 0].tolist()) == ([5, 5, 5], [6, 6, 6])
    assert frame.geometry.baseline_m == pytest.approx(0.075)


def test_colour_stays_as_it_is() -> None:
    pixels = message(size_hw=(40, 128, 3))
    assert np.shares_memory(to_frame(pixels, pixels, geometry=GEOMETRY, tolerance_secs=0.1).left, pixels.pixels)


def test_left_view_alone() -> None:
    assert to_frame(message(), message(), geometry=GEOMETRY, tolerance_secs=0.1, views="left").right is None


@pytest.mark.parametrize(
    ("right", "words"),
    [
        (message(at_secs=1.06), "60.0 ms apart"),
        (message(size_hw=(40, 64)), "64x40"),
    ],
)
def test_views_that_do_not_belong_together(right: CameraMessage, words: str) -> None:
    with pytest.raises(FrameError, match=words):
        to_frame(message(), right, geometry=GEOMETRY, tolerance_secs=0.05)


def endless() -> object:
    for number in count():
        pixels = np.zeros((40, 128, 3), np.uint8)
        yield StereoFrame(pixels, pixels, 0.0, number, str(number), GEOMETRY)


@pytest.mark.parametrize(
    ("options", "numbers"),
    [(SourceOptions(limit=3), [0, 1, 2]), (SourceOptions(start=2, step=3, limit=2), [2, 5])],
)
def test_choice_of_an_endless_stream(options: SourceOptions, numbers: list[int]) -> None:
    assert [frame.sequence for frame in choose(endless(), options)] == numbers  # type: ignore[arg-type]


def test_a_wanted_camera_is_named() -> None:
    pytest.importorskip("depthai")
    with pytest.raises(SourceError, match="'14442C10D13EABCE00'"):
        open_source("oak:14442C10D13EABCE00")


def test_host_pipeline_pairs_by_timestamp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two host cameras, the right one a little late and once missing, through Sync and the source's own loop."""
    depthai = pytest.importorskip("depthai")
    monkeypatch.setattr(oak, "SILENCE_SECS", 1.0)

    class HostCamera(depthai.node.ThreadedHostNode):
        def __init__(self) -> None:
            super().__init__()
            self.out = self.createOutput()
            self.grey, self.late_secs, self.missing = 0, 0.0, -1

        def run(self) -> None:
            for number in range(6):
                if number == self.missing or not self.isRunning():
                    continue
                image = depthai.ImgFrame()
                image.setCvFrame(np.full((40, 128), self.grey + number, np.uint8), depthai.ImgFrame.Type.GRAY8)
                image.setTimestamp(timedelta(seconds=100 + 0.1 * number + self.late_secs))
                image.setSequenceNum(number)
                self.out.send(image)
                time.sleep(0.05)

    with depthai.Pipeline(createImplicitDevice=False) as pipeline:
        left, right = pipeline.create(HostCamera), pipeline.create(HostCamera)
        right.grey, right.late_secs, right.missing = 100, 0.004, 2
        queue = oak.build_pairing(pipeline, left.out, right.out, fps=10, on_host=True)
        queue.setMaxSize(8)  # a slow test machine must not lose the pairs that are compared
        pipeline.start()
        frames = oak.frames_from_queue(queue, geometry=GEOMETRY, fps=10, views="both", uri="oak:")
        seen = [next(frames) for _ in range(5)]
        with pytest.raises(SourceError, match="sent nothing"):
            next(frames)
    assert [frame.sequence for frame in seen] == [0, 1, 3, 4, 5]
    for frame in seen:
        assert frame.right is not None
        assert int(frame.right[0, 0, 0]) - int(frame.left[0, 0, 0]) == 100
        assert frame.timestamp_secs == pytest.approx(100 + 0.1 * frame.sequence)


def test_a_closed_queue_is_a_lost_camera() -> None:
    depthai = pytest.importorskip("depthai")

    class Closed:
        def get(self, timeout: timedelta) -> None:
            raise depthai.MessageQueue.QueueException

    frames = oak.frames_from_queue(Closed(), geometry=GEOMETRY, fps=10, views="both", uri="oak:")
    with pytest.raises(SourceError, match="camera was lost"):
        next(frames)


def test_a_camera_that_was_not_entered() -> None:
    camera = oak.OakCamera("oak:", None, fps=10, size_wh=(128, 40), options=SourceOptions())
    with pytest.raises(SourceError, match="not started"):
        iter(camera)
    assert camera.frame_hz == 10


@pytest.mark.parametrize(
    ("trouble", "raised"),
    [
        (RuntimeError("X_LINK_ERROR\nmore"), SourceError),
        (RuntimeError(), SourceError),
        (FormatError("no stereo pair"), FormatError),
        (KeyboardInterrupt(), KeyboardInterrupt),
    ],
)
def test_a_start_that_fails_lets_the_device_go(
    trouble: BaseException, raised: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    let_go: list[str] = []

    class Device:
        def __init__(self, info: object) -> None:
            pass

        def __enter__(self) -> Device:
            return self

        def __exit__(self, *error: object) -> None:
            let_go.append("device")

        def readCalibration(self) -> None:
            raise trouble

    monkeypatch.setattr(oak, "import_depthai", lambda: SimpleNamespace(Device=Device))
    camera = oak.OakCamera("oak:", None, fps=10, size_wh=(128, 40), options=SourceOptions())
    with pytest.raises(raised) as ended:
        camera.__enter__()
    assert let_go == ["device"]
    assert "\n" not in str(ended.value)
