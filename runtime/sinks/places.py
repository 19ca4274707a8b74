"""Places to write to: nothing that is there already is replaced unless that was asked for."""

from __future__ import annotations

from pathlib import Path

from runtime.contracts.errors import OutputError


def claim_file(path: Path, *, overwrite: bool) -> Path:
    """The path, its folder made.

    Raises:
        OutputError: a file is there already, or the folder cannot be made.
    """
    if path.is_dir():
        raise OutputError(f"{path} is a folder, expected a file name; add one")
    if path.exists() and not overwrite:
        raise OutputError(f"{path} exists, expected a new file; choose another name or pass --overwrite")
    _make(path.parent)
    return path


def claim_folder(path: Path, *, overwrite: bool) -> Path:
    """The folder, made where it is missing. With ``overwrite``, files of equal names will be replaced,
    others stay.

    Raises:
        OutputError: it holds something already, is a file, or cannot be made.
    """
    if path.exists() and not path.is_dir():
        raise OutputError(f"{path} is a file, expected a folder; choose another name")
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise OutputError(
            f"{path} is not empty, expected a new or empty folder; choose another one or pass --overwrite"
        )
    _make(path)
    return path


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"folder {folder} cannot be made ({error.strerror}), expected a place to write; choose another one"
        ) from error
