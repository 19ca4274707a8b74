"""The files of a model directory, written beside its place, then renamed, so that a half-written one is never seen."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from runtime.contracts.errors import EdgeError, OutputError
from runtime.contracts.manifest import MANIFEST_FILE, MODEL_FILE, PRIORS_FILE, parse_manifest

CARD_FILE = "card.md"
CALIBRATION_FILE = "calibration.json"
REPORT_TEXT, REPORT_RECORD = "report.md", "report.json"
CURVE_RECORD, CURVE_PLOT = "curve.json", "curve.png"
BUDGET_PLOT, RANGES_PLOT = "budget.png", "ranges.png"
WRITTEN_FILES = (
    *(MODEL_FILE, MANIFEST_FILE, PRIORS_FILE, CARD_FILE, CALIBRATION_FILE),
    *(REPORT_TEXT, REPORT_RECORD, CURVE_RECORD, CURVE_PLOT, BUDGET_PLOT, RANGES_PLOT),
)
"""What a model directory may hold and still be replaced by a newer one."""
REPORT_PICTURES, PICTURE_SUFFIX = "report-pictures", ".jpg"
"""Folder of a report's pictures in a model directory; it may hold nothing else."""


@contextmanager
def replaced_directory(out: Path) -> Iterator[Path]:
    """Gives an empty folder beside ``out`` and renames it to ``out`` when the block ends without an error.

    Raises:
        OutputError: ``out`` is a file, or a folder that is neither empty nor a model directory of this project
            without foreign files, or cannot be written.
    """
    _refuse_foreign(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        folder = staging / "new"
        folder.mkdir()  # mkdtemp's own mode keeps other users out; this one follows the umask
        yield folder
        _swap(folder, out, retired=staging / "old")
    except OSError as error:
        raise _unwritable(out, error) from error
    finally:
        if out.exists() or not (staging / "old").exists():  # else the retired model is the only one there is
            shutil.rmtree(staging, ignore_errors=True)


def check_place(out: Path) -> None:
    """Whether `replaced_directory` has a chance, before hours of work; makes nothing.

    Raises:
        OutputError: ``out`` holds what is not to be replaced, or lies where nothing can be written.
    """
    _refuse_foreign(out)
    if out.is_mount() or out.resolve() == Path.cwd():
        raise OutputError(
            f"{out}: found a mount point or the folder that this runs in; expected one that can be renamed, since a "
            "finished model takes its place in one step; choose another --out, for example a folder within it"
        )
    nearest = next((folder for folder in out.absolute().parents if folder.exists()), None)
    if nearest is None or not nearest.is_dir() or not os.access(nearest, os.W_OK | os.X_OK):
        raise OutputError(
            f"{out}: found that {nearest} is no folder that can be written; expected a writable one; choose another"
            " --out"
        )


def _refuse_foreign(out: Path) -> None:
    if out.exists() and not _may_be_replaced(out):
        raise OutputError(
            f"{out}: found something that is no model directory, or one with files of your own; expected a free"
            " place or an older model directory; choose another --out"
        )


def _may_be_replaced(out: Path) -> bool:
    """An empty folder, or a model directory of this project that holds nothing but what this project wrote."""
    if not out.is_dir():
        return False
    names = {item.name for item in out.iterdir()}
    if not names:
        return True
    if MANIFEST_FILE not in names or names - {*WRITTEN_FILES, REPORT_PICTURES}:
        return False
    if any(item.suffix != PICTURE_SUFFIX for item in (out / REPORT_PICTURES).glob("*")):
        return False
    try:
        parse_manifest((out / MANIFEST_FILE).read_text(encoding="utf-8", errors="replace"))
    except EdgeError:
        return False
    return True


def _swap(folder: Path, out: Path, *, retired: Path) -> None:
    """Renames ``folder`` to ``out``; puts what was there back if that fails."""
    if out.exists():
        out.rename(retired)
    try:
        folder.rename(out)
    except BaseException:
        if retired.exists():
            retired.rename(out)
        raise


def _unwritable(out: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{out}: found that it cannot be written ({error.strerror}); expected a writable folder; choose another --out"
    )
