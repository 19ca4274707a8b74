"""``images:LEFT_GLOB,RIGHT_GLOB?geometry=FILE``: any rectified pairs in image files.

Files pair by stem; where no stem occurs on both sides, by sorted order if the counts agree. A folder stands
for all images in it. With ``views=left`` one pattern is enough.
"""

from __future__ import annotations

import glob
from pathlib import Path

from runtime.contracts.errors import FrameError, SourceError
from runtime.sources.base import DEFAULT_CAMERA_HZ
from runtime.sources.pairs import ImagePairs, PairFiles
from runtime.sources.pictures import IMAGE_SUFFIXES
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ("geometry",)


def open_images(uri: SourceUri, options: SourceOptions) -> ImagePairs:
    """The frames of two file patterns.

    Raises:
        SourceError: patterns or geometry are missing, a pattern finds no image, or the sides cannot be
            paired.
        FrameError: an image has no partner.
    """
    geometry = geometry_option(uri)
    patterns = split_target(uri, options, form="images:LEFT_GLOB,RIGHT_GLOB")
    lefts = _expand(patterns[0], uri=uri.text)
    if options.views == "left":
        couples: list[tuple[Path, Path | None]] = [(left, None) for left in lefts]
    else:
        couples = _couple(lefts, _expand(patterns[1], uri=uri.text), uri=uri.text)
    stems = [left.stem for left, _ in couples]
    unique = len(set(stems)) == len(stems)
    pairs = [
        PairFiles(
            frame_id=left.stem if unique else f"{index:06d}",
            left=left,
            right=right,
            calibration=geometry,
            timestamp_secs=index / DEFAULT_CAMERA_HZ,
        )
        for index, (left, right) in enumerate(couples)
    ]
    return ImagePairs(uri.text, pairs, options=options)


def geometry_option(uri: SourceUri) -> Path:
    """The file that ``geometry`` names.

    Raises:
        SourceError: the option is missing or names no file.
    """
    name = uri.options.get("geometry")
    if name is None:
        raise SourceError(
            f"{uri.text}: found no geometry, expected ?geometry=FILE (KITTI calibration text, JSON with P2 "
            "and P3, or a depthai calibration); add it"
        )
    if not Path(name).is_file():
        raise SourceError(f"{uri.text}: found no file {name}, expected the camera geometry; check the path")
    return Path(name)


def split_target(uri: SourceUri, options: SourceOptions, *, form: str) -> list[str]:
    """The comma-separated left and right part of a target; one is enough for ``views=left``.

    Raises:
        SourceError: there are none, too few or too many.
    """
    parts = uri.target.split(",")
    if not all(parts) or len(parts) > 2 or (len(parts) == 1 and options.views == "both"):
        raise SourceError(f"{uri.text}: found {uri.target!r}, expected {form}; name both views, with a comma between")
    return parts


def _expand(pattern: str, *, uri: str) -> list[Path]:
    whole = f"{glob.escape(pattern)}/*" if Path(pattern).is_dir() else pattern
    names = glob.glob(whole, recursive=True)  # noqa: PTH207 - Path.glob takes no absolute pattern
    paths = sorted(Path(name) for name in names if Path(name).suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise SourceError(
            f"{uri}: {pattern} finds no image, expected {', '.join(IMAGE_SUFFIXES)} files; check the pattern"
        )
    return paths


def _couple(lefts: list[Path], rights: list[Path], *, uri: str) -> list[tuple[Path, Path | None]]:
    by_stem = {path.stem: path for path in rights}
    left_stems = {path.stem for path in lefts}
    unique = len(by_stem) == len(rights) and len(left_stems) == len(lefts)
    if not unique or not left_stems & by_stem.keys():
        if len(lefts) != len(rights):
            raise SourceError(
                f"{uri}: found {len(lefts)} left and {len(rights)} right images without common names, "
                "expected equal names or equal counts; check the patterns"
            )
        if left_stems & by_stem.keys():
            for left, right in zip(lefts, rights, strict=True):
                if left.stem != right.stem:
                    raise FrameError(
                        f"frame {left.stem}: found {left} beside {right} in sorted order, expected equal names; add "
                        "what is missing or narrow the patterns"
                    )
        return list(zip(lefts, rights, strict=True))
    lonely = sorted(left_stems ^ by_stem.keys())
    if lonely:
        side = "right" if lonely[0] in left_stems else "left"
        raise FrameError(
            f"frame {lonely[0]}: found no {side} image, expected both views of each name ({len(lonely)} "
            "lack one); add it or narrow the patterns"
        )
    return [(left, by_stem[left.stem]) for left in lefts]
