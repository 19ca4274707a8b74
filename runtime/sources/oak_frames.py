"""From two camera messages to a stereo frame: the part of the OAK source that knows no device.

Messages arrive as plain arrays with a time and a number; frames leave with the left message's time and
number.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import islice

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.sources.uri import SourceOptions


@dataclass(frozen=True, slots=True)
class CameraMessage:
    """One rectified image as the camera sent it.

    Attributes:
        pixels: uint8, (H, W) grey or (H, W, 3) BGR.
        timestamp_secs: capture time on the host's monotonic clock.
        sequence: the device's running number.
    """

    pixels: NDArray[np.uint8]
    timestamp_secs: float
    sequence: int


def to_frame(
    left: CameraMessage,
    right: CameraMessage,
    *,
    geometry: StereoGeometry,
    tolerance_secs: float,
    views: str = "both",
) -> StereoFrame:
    """Join the two views of one moment.

    Args:
        left, right: messages.
        geometry: of the rectified pair.
        tolerance_secs: most that the two capture times may differ.
        views: ``left`` leaves the right view out.

    Raises:
        FrameError: the two are of different moments, of unequal size, or do not fit the geometry.
    """
    apart_secs = abs(left.timestamp_secs - right.timestamp_secs)
    if apart_secs > tolerance_secs:
        raise FrameError(
            f"frame {left.sequence}: left and right are {apart_secs * 1e3:.1f} ms apart, expected at most "
            f"{tolerance_secs * 1e3:.1f} ms; check that both cameras run at one rate"
        )
    return StereoFrame(
        left=_colour(left.pixels),
        right=None if views == "left" else _colour(right.pixels),
        timestamp_secs=left.timestamp_secs,
        sequence=left.sequence,
        frame_id=f"{left.sequence:06d}",
        geometry=geometry,
    )


def choose(frames: Iterable[StereoFrame], options: SourceOptions) -> Iterator[StereoFrame]:
    """Apply start, step and limit to a stream that has no end."""
    wanted = islice(frames, options.start, None, options.step)
    return wanted if options.limit is None else islice(wanted, options.limit)


def _colour(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if pixels.ndim == 3:
        return pixels
    colour: NDArray[np.uint8] = cv2.cvtColor(pixels, cv2.COLOR_GRAY2BGR)
    return colour
