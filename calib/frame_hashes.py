"""Names frames by hashes of their pixels and camera, and decodes no file that was decoded before."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from calib.feature_cache import FeatureCache
from calib.frames import SHORT_HASH, ChosenFrame, geometry_hash, pixel_hash
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.sources.pairs import ImagePairs

_METHOD = f"pixels-1 by encoded views, OpenCV {cv2.__version__}"
"""Changes with `calib.frames.pixel_hash` and with how images are read, so that no older hash is taken for a new one."""
_WORD_DIGITS = SHORT_HASH // 2


@dataclass(frozen=True, slots=True)
class HashedFrame:
    """A frame that may not have been decoded.

    Attributes:
        chosen: its name, place and hashes.
        geometry: its camera.
        read: gives the frame itself.
    """

    chosen: ChosenFrame
    geometry: StereoGeometry
    read: Callable[[], StereoFrame]


class FrameHashes:
    """Hashes of a source's frames; a context manager that remembers them when left without an error.

    What is remembered goes by what the image files hold, not by their names or dates; the camera is always read anew.
    """

    def __init__(self, source: Sequence[StereoFrame], *, enabled: bool = True) -> None:
        """Takes a source.

        Args:
            source: Entered frames by index.
            enabled: Look for, and keep, hashes in the user's cache folder.
        """
        self._source = source
        self._known = FeatureCache(_METHOD, enabled=enabled, number=np.uint32)
        self._enabled = enabled

    def __enter__(self) -> Self:
        """Reads what is kept."""
        self._known.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keeps the newest hashes."""
        self._known.__exit__(kind, error, trace)

    def __getitem__(self, index: int) -> HashedFrame:
        """The frame's hashes.

        Raises:
            FrameError: an image is missing, broken or of another size.
            FormatError: the calibration is wrong.
        """
        source = self._source
        if not (self._enabled and isinstance(source, ImagePairs)):
            return _decoded(source[index], index)
        views = source.views_digest(index)
        known = self._known.get(views, size=4)
        if known is None:
            seen = _decoded(source[index], index)
            pixels = seen.chosen.pixels
            row = (int(pixels[:_WORD_DIGITS], 16), int(pixels[_WORD_DIGITS:], 16), *seen.geometry.image_size_wh)
            self._known.put(views, np.array(row, np.uint32))
            return seen
        first, second, width, height = (int(number) for number in known)
        geometry = source.geometry(index, (width, height))
        chosen = ChosenFrame(
            source.frame_id(index),
            index,
            f"{first:0{_WORD_DIGITS}x}{second:0{_WORD_DIGITS}x}",
            geometry_hash(geometry),
        )
        return HashedFrame(chosen, geometry, cache(lambda: source[index]))


def _decoded(frame: StereoFrame, index: int) -> HashedFrame:
    chosen = ChosenFrame(frame.frame_id, index, pixel_hash(frame), geometry_hash(frame.geometry))
    return HashedFrame(chosen, frame.geometry, lambda: frame)
