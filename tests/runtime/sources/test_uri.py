"""Source URIs."""

from __future__ import annotations

import pytest

from runtime.contracts.errors import SourceError
from runtime.sources.uri import SourceOptions, common_options, parse_uri


@pytest.mark.parametrize("text", ["", "nothing", ":target", "/a/path"])
def test_no_scheme(text: str) -> None:
    with pytest.raises(SourceError, match="no scheme"):
        parse_uri(text)


@pytest.mark.parametrize(
    ("text", "scheme", "target", "options"),
    [
        ("kitti-raw:/a/b", "kitti-raw", "/a/b", {}),
        ("oak:", "oak", "", {}),
        ("oak:?fps=5", "oak", "", {"fps": "5"}),
        ("kitti-object:a?split=val&limit=3", "kitti-object", "a", {"split": "val", "limit": "3"}),
        ("images:a?.png,b?.png", "images", "a?.png,b?.png", {}),  # question marks of a pattern
        ("images:a?.png,b?.png?geometry=c.txt", "images", "a?.png,b?.png", {"geometry": "c.txt"}),
        ("kitti-raw:a?rate", "kitti-raw", "a", {"rate": "camera"}),
        ("kitti-raw:a?rate&limit=2", "kitti-raw", "a", {"rate": "camera", "limit": "2"}),
        ("video:C:/a.mp4?geometry=g", "video", "C:/a.mp4", {"geometry": "g"}),
    ],
)
def test_parts(text: str, scheme: str, target: str, options: dict[str, str]) -> None:
    parsed = parse_uri(text)
    assert (parsed.scheme, parsed.target, parsed.options) == (scheme, target, options)


def test_defaults() -> None:
    assert common_options(parse_uri("oak:")) == SourceOptions(0, 1, None, None, "both")


@pytest.mark.parametrize(("text", "rate"), [("rate", "camera"), ("rate=camera", "camera"), ("rate=2.5", 2.5)])
def test_rate(text: str, rate: float | str) -> None:
    assert common_options(parse_uri(f"kitti-raw:a?{text}&limit=1")).rate == rate


@pytest.mark.parametrize(
    ("options", "count", "rows"),
    [
        (SourceOptions(), 1, [0]),
        (SourceOptions(limit=5), 3, [0, 1, 2]),
        (SourceOptions(start=1, step=2), 6, [1, 3, 5]),
        (SourceOptions(start=1, step=2, limit=2), 6, [1, 3]),
        (SourceOptions(start=5), 6, [5]),
    ],
)
def test_rows(options: SourceOptions, count: int, rows: list[int]) -> None:
    assert list(options.rows(count, uri="x")) == rows


@pytest.mark.parametrize(("options", "count"), [(SourceOptions(), 0), (SourceOptions(start=6), 6)])
def test_no_row_is_left(options: SourceOptions, count: int) -> None:
    with pytest.raises(SourceError, match=f"none of {count} frames"):
        options.rows(count, uri="x")
