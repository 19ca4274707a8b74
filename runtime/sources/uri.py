"""Source URIs: ``SCHEME:TARGET?option=value&option=value``, parsed strictly.

Options that every source knows: ``start`` (first frame), ``step`` (every n-th), ``limit`` (at most so many),
``rate`` (replay at a pace: ``rate=camera`` at the recording's own, ``rate=5`` at 5 Hz), ``views=left``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from runtime.contracts.errors import SourceError

COMMON_OPTIONS = ("limit", "start", "step", "rate", "views")
CAMERA_RATE = "camera"


@dataclass(frozen=True, slots=True)
class SourceUri:
    """A URI taken apart.

    Attributes:
        text: the whole URI; scheme: before the first colon; target: path, paths or device name; options: by
            name.
    """

    text: str
    scheme: str
    target: str
    options: dict[str, str]


@dataclass(frozen=True, slots=True)
class SourceOptions:
    """What every source can be told.

    Attributes:
        start: index of the first frame.
        step: every how manieth frame.
        limit: most frames, None for all.
        rate: None as fast as they are asked for, ``camera`` at their timestamps' pace, or a rate in Hz.
        views: ``both``, or ``left`` for the left view alone.
    """

    start: int = 0
    step: int = 1
    limit: int | None = None
    rate: float | Literal["camera"] | None = None
    views: Literal["both", "left"] = "both"

    def rows(self, count: int, *, uri: str) -> range:
        """Indices of the wanted frames out of ``count``.

        Raises:
            SourceError: none is left.
        """
        rows = range(self.start, count, self.step)
        rows = rows if self.limit is None else rows[: self.limit]
        if not rows:
            raise SourceError(
                f"{uri}: start={self.start} leaves none of {count} frames, expected 0 to {count - 1}; lower start"
            )
        return rows


def parse_uri(text: str) -> SourceUri:
    """Take a URI apart; which schemes and options exist is the factory's business.

    The options begin at the last question mark that has an equals sign (or the bare word ``rate``) behind
    it, so that file patterns may hold question marks.

    Raises:
        SourceError: there is no scheme, an option has no value, or one is given twice.
    """
    scheme, colon, rest = text.partition(":")
    if not colon or not scheme:
        raise SourceError(
            f"source {text!r} has no scheme, expected SCHEME:TARGET?option=value; "
            "for example kitti-object:ROOT?split=val"
        )
    target, mark, tail = rest.rpartition("?")
    if not mark or not ("=" in tail or tail == "rate"):
        return SourceUri(text, scheme, rest, {})
    options: dict[str, str] = {}
    for part in tail.split("&"):
        name, equals, value = part.partition("=")
        if part == "rate":
            value = CAMERA_RATE
        elif not equals or not name or not value:
            raise SourceError(f"source {text!r}: found option {part!r}, expected name=value; mend the URI")
        if name in options:
            raise SourceError(f"source {text!r}: option {name!r} is given twice, expected once; remove one")
        options[name] = value
    return SourceUri(text, scheme, target, options)


def common_options(uri: SourceUri) -> SourceOptions:
    """The options of all sources.

    Raises:
        SourceError: a value is not of its kind.
    """
    views = uri.options.get("views", "both")
    if views not in ("both", "left"):
        raise SourceError(f"{uri.text}: views={views}, expected left or both; choose one")
    limit = uri.options.get("limit")
    return SourceOptions(
        start=_whole(uri, "start", uri.options.get("start", "0"), least=0),
        step=_whole(uri, "step", uri.options.get("step", "1"), least=1),
        limit=None if limit is None else _whole(uri, "limit", limit, least=1),
        rate=_rate(uri),
        views="left" if views == "left" else "both",
    )


def _rate(uri: SourceUri) -> float | Literal["camera"] | None:
    text = uri.options.get("rate")
    if text is None:
        return None
    return "camera" if text == CAMERA_RATE else positive_number(uri, "rate", text)


def positive_number(uri: SourceUri, name: str, text: str) -> float:
    """An option's value as a number above zero and at most 1000.

    Raises:
        SourceError: it is something else.
    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0.0 < value <= 1000.0:
        raise SourceError(f"{uri.text}: {name}={text}, expected a number above 0, at most 1000; give a rate in Hz")
    return value


def _whole(uri: SourceUri, name: str, text: str, *, least: int) -> int:
    if not text.isdecimal() or int(text) < least:
        raise SourceError(f"{uri.text}: {name}={text}, expected a whole number, {least} or more; mend the URI")
    return int(text)
