"""Frames that were chosen, their hashes, and what the network is fed of them.

The two views of a frame stay together. What was chosen is written down with a hash of the pixels, so that a
later run can tell whether it saw the same and whether a measuring source overlaps.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from calib.coverage import Coverage
from runtime.contracts.errors import SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.manifest import Manifest
from runtime.preprocess import NetworkView, network_view, prepare
from runtime.rig import check_rig

SHORT_HASH = 16

Warn = Callable[[str], None]
Check = Callable[[StereoGeometry], object]
"""Raises where a camera does not fit."""


def say_nothing(line: str) -> None:
    """Tells nobody."""


def accept_any(geometry: StereoGeometry) -> None:
    """Fits every camera."""


@dataclass(frozen=True, slots=True)
class ChosenFrame:
    """One calibration frame.

    Attributes:
        frame_id: its name in the source.
        index: its place in the source.
        pixels: start of the SHA-256 over the pixels of both views.
        geometry: start of the SHA-256 over P2, P3 and the image size.
    """

    frame_id: str
    index: int
    pixels: str
    geometry: str


@dataclass(frozen=True, slots=True)
class CalibrationSet:
    """The frames that were used.

    Attributes:
        source: what names the source (its URI, without the folders above it where it lies in the package).
        frames: in the order of the choice: the first few of them are the choice of a few.
        available: how many frames the source had.
        method: how they were chosen, one of `calib.choice.METHODS`.
        coverage: how well they stand for the source; None where that was not looked at.
    """

    source: str
    frames: tuple[ChosenFrame, ...]
    available: int
    method: str
    coverage: Coverage | None = None

    def first(self, few: int) -> CalibrationSet:
        """The choice of a few: what they show says nothing of how well all stand for the source."""
        return replace(self, frames=self.frames[:few], coverage=None)

    @property
    def digest(self) -> str:
        """One hash for all pixels, in order."""
        return hashlib.sha256("".join(frame.pixels for frame in self.frames).encode()).hexdigest()

    @property
    def geometry_digest(self) -> str:
        """One hash for the cameras of all frames, in order."""
        return hashlib.sha256("".join(frame.geometry for frame in self.frames).encode()).hexdigest()


def spread_indices(available: int, wanted: int) -> tuple[int, ...]:
    """Indices at equal distances, the middle of ``wanted`` equal parts; all, where there are fewer.

    Raises:
        SourceError: none is available, or none is wanted.
    """
    if wanted < 1:
        raise SourceError(f"--frames: found {wanted}; expected 1 or more; 100 serve well")
    if available < 1:
        raise SourceError("calibration source: found no frames; expected one or more; check the folder and the options")
    if wanted >= available:
        return tuple(range(available))
    return tuple(int((2 * part + 1) * available // (2 * wanted)) for part in range(wanted))


def pixel_hash(frame: StereoFrame) -> str:
    """Start of the SHA-256 over the frame's pixels, left then right."""
    digest = hashlib.sha256(frame.left.tobytes())
    if frame.right is not None:
        digest.update(frame.right.tobytes())
    return digest.hexdigest()[:SHORT_HASH]


def geometry_hash(geometry: StereoGeometry) -> str:
    """Start of the SHA-256 over P2, P3 and the image size, which decide what the network sees of the pixels."""
    digest = hashlib.sha256(repr(geometry.image_size_wh).encode())
    for projection in (geometry.P2, geometry.P3):
        digest.update(projection.tobytes())
    return digest.hexdigest()[:SHORT_HASH]


def spread_frames(source: Sequence[StereoFrame], wanted: int) -> Iterator[StereoFrame]:
    """Yields frames of a source, sampled over its length, one at a time.

    Args:
        source: Entered frames by index.
        wanted: How many.

    Raises:
        SourceError: no frame.
    """
    for index in spread_indices(len(source), wanted):
        yield source[index]


def frame_feeds(
    frames: Iterable[StereoFrame], manifest: Manifest, *, allow_other_rig: bool = False, warn: Warn = say_nothing
) -> Iterator[dict[str, NDArray[Any]]]:
    """The graph's feeds of each frame.

    Args:
        frames: Camera pairs.
        manifest: Of the model.
        allow_other_rig: Accept cameras far from those of the training data.
        warn: Told once where the camera differs somewhat.

    Raises:
        RigError: A camera is too far from those of the training data.
        FrameError: A frame lacks a view that the model needs, or is too small.
    """
    view_of = rig_check(manifest, allow_other_rig=allow_other_rig, warn=warn)
    for frame in frames:
        yield prepare(frame, view_of(frame.geometry), manifest)


def rig_check(
    manifest: Manifest, *, allow_other_rig: bool = False, warn: Warn = say_nothing
) -> Callable[[StereoGeometry], NetworkView]:
    """A function that gives what the network sees of a camera's frames, once that camera has passed the check.

    Args:
        manifest: Of the model.
        allow_other_rig: Accept cameras far from those of the training data.
        warn: Told once where a camera differs somewhat.

    The function raises RigError where a camera is too far from those of the training data, FrameError where a
    frame of that camera is too small.
    """
    warned = False

    def view_of(geometry: StereoGeometry) -> NetworkView:
        nonlocal warned
        view = network_view(geometry, manifest)
        notice = check_rig(view.geometry, manifest.rig, stereo=manifest.views == 2, allow=allow_other_rig)
        if notice is not None and not warned:
            warned = True
            warn(notice)
        return view

    return view_of
