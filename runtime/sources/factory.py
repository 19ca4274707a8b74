"""From a URI to a source."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from runtime.contracts.errors import SourceError
from runtime.sources import images, kitti_object, kitti_odometry, kitti_raw, kitti_tracking, oak, video
from runtime.sources.base import FrameSequence, Source, as_sequence
from runtime.sources.uri import COMMON_OPTIONS, SourceOptions, SourceUri, common_options, parse_uri


@dataclass(frozen=True, slots=True)
class _Kind:
    """One scheme: how to open it, its own options, and how its URI looks."""

    open: Callable[[SourceUri, SourceOptions], Source]
    options: tuple[str, ...]
    form: str


KINDS = {
    "kitti-object": _Kind(kitti_object.open_kitti_object, kitti_object.OPTIONS, "kitti-object:ROOT?split=val"),
    "kitti-tracking": _Kind(
        kitti_tracking.open_kitti_tracking, kitti_tracking.OPTIONS, "kitti-tracking:ROOT?sequence=0001"
    ),
    "kitti-raw": _Kind(kitti_raw.open_kitti_raw, kitti_raw.OPTIONS, "kitti-raw:DRIVE"),
    "kitti-odometry": _Kind(
        kitti_odometry.open_kitti_odometry, kitti_odometry.OPTIONS, "kitti-odometry:ROOT?sequence=04"
    ),
    "images": _Kind(images.open_images, images.OPTIONS, "images:LEFT_GLOB,RIGHT_GLOB?geometry=FILE"),
    "video": _Kind(video.open_video, video.OPTIONS, "video:LEFT,RIGHT?geometry=FILE"),
    "oak": _Kind(oak.open_oak, oak.OPTIONS, "oak:[DEVICE]?fps=10&size=1280x400"),
}


def open_source(uri: str) -> Source:
    """The source that a URI names; use it in a ``with`` block.

    Raises:
        SourceError: the scheme or an option is unknown, or what the URI names is not there.
        FrameError: an image of a wanted frame is missing.
        MissingExtraError: the source needs a package that is not installed.
    """
    parsed = parse_uri(uri)
    kind = KINDS.get(parsed.scheme)
    if kind is None:
        raise SourceError(
            f"source {uri!r} has the unknown scheme {parsed.scheme!r}, expected one of {', '.join(KINDS)}; "
            "for example kitti-object:ROOT?split=val"
        )
    known = (*kind.options, *COMMON_OPTIONS)
    unknown = [name for name in parsed.options if name not in known]
    if unknown:
        raise SourceError(
            f"source {uri!r} has the unknown option {unknown[0]!r}, expected one of {', '.join(known)}; "
            f"the form is {kind.form}"
        )
    if not parsed.target and parsed.scheme != "oak":
        raise SourceError(f"source {uri!r} names nothing after the colon, expected {kind.form}; add it")
    return kind.open(parsed, common_options(parsed))


def open_sequence(uri: str) -> FrameSequence:
    """As `open_source`, for work that needs frames by index: labels, calibration, measuring.

    Raises:
        SourceError: the source is live.
    """
    return as_sequence(open_source(uri))
