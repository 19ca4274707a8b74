"""``oak:[DEVICE]?fps=10&size=1280x400``: an OAK camera through depthai 3.

The camera rectifies both views and pairs them by timestamp; the geometry comes from its calibration. This
file talks to the device; what happens to the messages is in `runtime.sources.oak_frames`, what the
calibration means in `runtime.depthai_rig`.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import timedelta
from types import TracebackType
from typing import Any, Self

from runtime.contracts.errors import MissingExtraError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.depthai_rig import parse_depthai_calibration
from runtime.sources.oak_frames import CameraMessage, choose, to_frame
from runtime.sources.uri import SourceOptions, SourceUri, positive_number

OPTIONS = ("fps", "size")
DEFAULT_FPS = "10"
DEFAULT_SIZE = "1280x400"
SILENCE_SECS = 5.0
"""A camera that sends nothing for so long is gone."""
PAIRING_SHARE = 0.5
"""Share of a frame interval that the two capture times may lie apart."""
LEFT, RIGHT = "left", "right"


def open_oak(uri: SourceUri, options: SourceOptions) -> OakCamera:
    """A camera that is there; it starts when the source is entered.

    Raises:
        MissingExtraError: depthai is not installed.
        SourceError: an option is wrong, or no such camera is connected.
    """
    if options.rate is not None:
        raise SourceError(f"{uri.text}: found rate, expected fps for a camera; write fps=10")
    fps = positive_number(uri, "fps", uri.options.get("fps", DEFAULT_FPS))
    size_wh = _size(uri)
    depthai = import_depthai()
    found = depthai.Device.getAllAvailableDevices()
    names = [(info.name, info.getDeviceId()) for info in found]
    wanted = [info for info, both in zip(found, names, strict=True) if uri.target in ("", *both)]
    if not wanted:
        listed = ", ".join(f"{name} ({device_id})" for name, device_id in names) or "none"
        what = f"OAK camera {uri.target!r}" if uri.target else "OAK camera"
        raise SourceError(
            f"found no {what} (connected: {listed}), expected one on USB or network; plug it in, and on "
            "Linux allow USB vendor 03e7 in the udev rules"
        )
    return OakCamera(uri.text, wanted[0], fps=fps, size_wh=size_wh, options=options)


class OakCamera:
    """A running camera; live, so that frames which nobody fetches in time are lost."""

    is_live = True
    arrives_at_camera_pace = True

    def __init__(
        self, uri: str, device_info: Any, *, fps: float, size_wh: tuple[int, int], options: SourceOptions
    ) -> None:
        """Remembers what to start."""
        self.uri = uri
        self._device_info = device_info
        self._fps = fps
        self._size_wh = size_wh
        self._options = options
        self._stack = ExitStack()
        self._queue: Any = None
        self._geometry: StereoGeometry | None = None

    @property
    def frame_hz(self) -> float:
        """Rate of the yielded frames."""
        return self._fps / self._options.step

    def __enter__(self) -> Self:
        """Connects, reads the calibration, starts the cameras.

        Raises:
            SourceError: the device does not answer.
            FormatError: it holds no calibration of its stereo pair.
        """
        depthai = import_depthai()
        try:
            device = self._stack.enter_context(depthai.Device(self._device_info))
            calibration = device.readCalibration()
            self._geometry = parse_depthai_calibration(calibration.eepromToJson(), self._size_wh, where=self.uri)
            pipeline = self._stack.enter_context(depthai.Pipeline(device))
            left, right = build_rectified_pair(
                pipeline,
                sockets=(calibration.getStereoLeftCameraId(), calibration.getStereoRightCameraId()),
                size_wh=self._size_wh,
                fps=self._fps,
            )
            self._queue = build_pairing(pipeline, left, right, fps=self._fps, on_host=False)
            pipeline.start()
        except BaseException as error:  # also an interrupt: a device that is not let go stays taken
            self._queue = None
            self._stack.close()
            if not isinstance(error, RuntimeError):
                raise
            said = (str(error).splitlines() or ["no reason given"])[0]
            raise SourceError(
                f"{self.uri}: the camera does not start ({said}), expected a free OAK "
                "device with a stereo pair; unplug it and plug it in again"
            ) from error
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops the cameras and lets the device go."""
        self._queue = None
        self._stack.close()

    def __iter__(self) -> Iterator[StereoFrame]:
        """Frames as they come, the newest first in line."""
        if self._queue is None or self._geometry is None:
            raise SourceError(f"{self.uri}: the camera is not started, expected a with block; enter it first")
        frames = frames_from_queue(
            self._queue, geometry=self._geometry, fps=self._fps, views=self._options.views, uri=self.uri
        )
        return choose(frames, self._options)


def build_rectified_pair(
    pipeline: Any, *, sockets: tuple[Any, Any], size_wh: tuple[int, int], fps: float
) -> tuple[Any, Any]:
    """Both cameras and the node that rectifies them; returns its two outputs."""
    depthai = import_depthai()
    stereo = pipeline.create(depthai.node.StereoDepth)
    stereo.setRectification(True)
    for socket, entry in zip(sockets, (stereo.left, stereo.right), strict=True):
        camera = pipeline.create(depthai.node.Camera).build(socket)
        camera.requestOutput(size_wh, type=depthai.ImgFrame.Type.GRAY8, fps=fps).link(entry)
    return stereo.rectifiedLeft, stereo.rectifiedRight


def build_pairing(pipeline: Any, left: Any, right: Any, *, fps: float, on_host: bool) -> Any:
    """A queue of message groups ``left``, ``right`` of one moment, newest only.

    Args:
        pipeline: to add the node to.
        left, right: outputs that send rectified images.
        fps: camera rate; half an interval is the most that a pair may lie apart.
        on_host: pair on this computer instead of on the camera.
    """
    depthai = import_depthai()
    sync = pipeline.create(depthai.node.Sync)
    sync.setRunOnHost(on_host)
    sync.setSyncThreshold(timedelta(seconds=PAIRING_SHARE / fps))
    left.link(sync.inputs[LEFT])
    right.link(sync.inputs[RIGHT])
    return sync.out.createOutputQueue(maxSize=1, blocking=False)


def frames_from_queue(
    queue: Any, *, geometry: StereoGeometry, fps: float, views: str, uri: str
) -> Iterator[StereoFrame]:
    """Frames of a pairing queue, until nobody asks for more.

    Raises:
        SourceError: nothing came for `SILENCE_SECS`, or the queue was closed, as depthai does with a lost camera.
        FrameError: a pair does not fit together or the geometry.
    """
    depthai = import_depthai()
    while True:
        try:
            group = queue.get(timeout=timedelta(seconds=SILENCE_SECS))
        except depthai.MessageQueue.QueueException:
            raise SourceError(
                f"{uri}: the camera was lost, expected {fps:g} pairs a second; check the cable and the power supply"
            ) from None
        if group is None:
            raise SourceError(
                f"{uri}: the camera sent nothing for {SILENCE_SECS:.0f} s, expected {fps:g} pairs a second; "
                "check the cable and the power supply"
            )
        yield to_frame(
            _message(group[LEFT]),
            _message(group[RIGHT]),
            geometry=geometry,
            tolerance_secs=PAIRING_SHARE / fps,
            views=views,
        )


def import_depthai() -> Any:
    """The depthai module, its own log switched off unless ``DEPTHAI_LEVEL`` says otherwise.

    Raises:
        MissingExtraError: it is not installed.
    """
    os.environ.setdefault("DEPTHAI_LEVEL", "off")
    try:
        import depthai
    except ModuleNotFoundError as error:
        raise MissingExtraError(
            f"found no {error.name}, expected it for an OAK camera; run: pip install '.[oak]'"
        ) from None
    return depthai


def _message(image: Any) -> CameraMessage:
    return CameraMessage(
        pixels=image.getCvFrame(),
        timestamp_secs=image.getTimestamp().total_seconds(),
        sequence=image.getSequenceNum(),
    )


def _size(uri: SourceUri) -> tuple[int, int]:
    text = uri.options.get("size", DEFAULT_SIZE)
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) and int(height)):
        raise SourceError(f"{uri.text}: size={text}, expected WIDTHxHEIGHT; write size=1280x400")
    return int(width), int(height)
