"""Labels and detections of a set of frames from folders of KITTI text."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from runtime.contracts.errors import FormatError, SourceError
from runtime.contracts.kitti import parse_detections, parse_labels
from runtime.contracts.objects import Detections3D, Objects3D

SUFFIX = ".txt"


@dataclass(frozen=True, slots=True)
class TextFrames:
    """Frames in the order of the split, or of their names.

    Attributes:
        frame_ids: names; labels, detections: one record each.
    """

    frame_ids: tuple[str, ...]
    labels: tuple[Objects3D, ...]
    detections: tuple[Detections3D, ...]


def read_text_frames(labels: Path, detections: Path, split: Path | None = None) -> TextFrames:
    """Read the frames that ``split`` names, or else those that have a detection file.

    Args:
        labels: folder of ``FRAME.txt`` label files; frame ids with a slash lie in sub-folders.
        detections: folder of ``FRAME.txt`` result files; an empty file is a frame without detections.
        split: text file, one frame id a line.

    Raises:
        SourceError: a folder, the split, or a file of a frame is missing.
        FormatError: a file is not KITTI text, or the split names no frame or one twice.
    """
    for folder, what in ((labels, "label"), (detections, "detection")):
        if not folder.is_dir():
            raise SourceError(f"{folder} is not a folder, expected one with {what} files FRAME{SUFFIX}; check the path")
    frame_ids = _detected_frames(detections) if split is None else read_split(split)
    origin = f"the split {split}" if split is not None else f"the result files in {detections}"
    _refuse_missing(
        labels, frame_ids, f"a label file for each frame of {origin}; add them, or choose frames with --split"
    )
    _refuse_missing(
        detections,
        frame_ids,
        f"a result file for each frame of {origin}; make an empty one if nothing was found",
    )
    return TextFrames(
        frame_ids=frame_ids,
        labels=tuple(parse_labels(_read(path), where=str(path)) for path in _files(labels, frame_ids)),
        detections=tuple(parse_detections(_read(path), where=str(path)) for path in _files(detections, frame_ids)),
    )


def read_split(path: Path) -> tuple[str, ...]:
    """Frame ids of a split file, one a line.

    Raises:
        SourceError: the file is missing.
        FormatError: it names no frame, or one twice.
    """
    if not path.is_file():
        raise SourceError(f"{path} is not a file, expected a split: one frame id a line; check the path")
    names = _read(path).split()
    if not names:
        raise FormatError(f"{path} names no frame, expected one frame id a line; mend the file")
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise FormatError(f"{path} names {twice} twice, expected each frame once; remove the repetition")
    return tuple(names)


def _detected_frames(folder: Path) -> tuple[str, ...]:
    paths = sorted(folder.rglob(f"*{SUFFIX}"))
    if not paths:
        raise SourceError(
            f"{folder} holds no {SUFFIX} file, expected result files FRAME{SUFFIX}; "
            "check the path, or choose frames with --split"
        )
    return tuple(path.relative_to(folder).with_suffix("").as_posix() for path in paths)


def _files(folder: Path, frame_ids: tuple[str, ...]) -> list[Path]:
    return [folder / f"{name}{SUFFIX}" for name in frame_ids]


def _refuse_missing(folder: Path, frame_ids: tuple[str, ...], expected: str) -> None:
    missing = [path for path in _files(folder, frame_ids) if not path.is_file()]
    if missing:
        raise SourceError(f"{missing[0]} is missing ({len(missing)} of {len(frame_ids)} are), expected {expected}")


def _read(path: Path) -> str:
    return path.read_text(encoding="utf-8", errors="replace")
