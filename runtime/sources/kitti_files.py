"""What the KITTI layouts share: folders that must be there, object labels, camera times."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from runtime.contracts.errors import FormatError, SourceError
from runtime.sources.base import DEFAULT_CAMERA_HZ


def expect_folder(folder: Path, *, uri: str, layout: str) -> Path:
    """The folder itself.

    Raises:
        SourceError: it is not there.
    """
    if not folder.is_dir():
        raise SourceError(f"{uri}: found no folder {folder}, expected {layout}; check the path")
    return folder


def expect_file(path: Path, *, uri: str, layout: str) -> Path:
    """The file itself.

    Raises:
        SourceError: it is not there.
    """
    if not path.is_file():
        raise SourceError(f"{uri}: found no file {path}, expected {layout}; check the path")
    return path


def sequence_folders(parent: Path, wanted: str | None, *, uri: str) -> list[Path]:
    """The folders of the wanted sequence, or of all of them.

    Args:
        parent: folder that holds one folder a sequence.
        wanted: its name; leading zeros may be left out; None for all.
        uri: for messages.

    Raises:
        SourceError: there is no such sequence, or none at all.
    """
    found = {path.name: path for path in sorted(parent.iterdir()) if path.is_dir()}
    if not found:
        raise SourceError(f"{uri}: {parent} holds no sequence, expected one folder each; check the path")
    if wanted is None:
        return list(found.values())
    for name, path in found.items():
        if name == wanted or (wanted.isdecimal() and name == wanted.zfill(len(name))):
            return [path]
    raise SourceError(f"{uri}: found no sequence {wanted!r}, expected one of {', '.join(found)}; choose one")


def frame_number(stem: str, *, where: Path) -> int:
    """The number that a file is named by.

    Raises:
        FormatError: the name is no number.
    """
    if not stem.isdecimal():
        raise FormatError(f"{where} is named {stem!r}, expected a frame number such as 000012; rename it")
    return int(stem)


def text_of(path: Path) -> str | None:
    """A text file's content, None where there is no file; bytes that are no UTF-8 become what no number or name is."""
    return path.read_text(encoding="utf-8", errors="replace") if path.is_file() else None


def read_seconds(path: Path) -> list[float] | None:
    """A list of camera times: seconds (odometry) or dates with nanoseconds (raw); None where there is no
    file.

    Raises:
        FormatError: a line is neither.
    """
    text = text_of(path)
    if text is None:
        return None
    seconds = []
    for number, line in enumerate(text.split("\n"), start=1):
        if not line.strip():
            continue
        try:
            seconds.append(_seconds(line.strip()))
        except ValueError:
            raise FormatError(
                f"{path} line {number} is {line[:40]!r}, expected seconds or a date with time; mend the file"
            ) from None
    return seconds


def time_of(number: int, seconds: list[float] | None) -> float:
    """Time of a frame: from the list where it reaches, else at the usual camera rate."""
    if seconds is not None and number < len(seconds):
        return seconds[number]
    return number / DEFAULT_CAMERA_HZ


def _seconds(text: str) -> float:
    if "-" not in text.lstrip("-") or ":" not in text:
        return float(text)
    moment, _, fraction = text.partition(".")
    return datetime.fromisoformat(moment + "+00:00").timestamp() + float(f"0.{fraction or 0}")
