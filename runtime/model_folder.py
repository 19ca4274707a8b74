"""Places a model directory: written beside its place, then renamed, so that a half-written one is never seen."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from runtime.contracts.errors import OutputError
from runtime.contracts.manifest import MANIFEST_FILE


@contextmanager
def replaced_directory(out: Path) -> Iterator[Path]:
    """Gives an empty folder beside ``out`` and renames it to ``out`` when the block ends without an error.

    Raises:
        OutputError: ``out`` is a file, or a folder that is neither empty nor a model directory, or cannot be
            written.
    """
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / MANIFEST_FILE).is_file())):
        raise OutputError(
            f"{out}: found something that is no model directory; expected a free place or an older model"
            " directory; choose another --out"
        )
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
        shutil.rmtree(staging, ignore_errors=True)


def _swap(folder: Path, out: Path, *, retired: Path) -> None:
    """Renames ``folder`` to ``out``; puts what was there back if that fails."""
    if out.exists():
        out.rename(retired)
    try:
        folder.rename(out)
    except OSError:
        if retired.exists():
            retired.rename(out)
        raise


def _unwritable(out: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{out}: found that it cannot be written ({error.strerror}); expected a writable folder; choose another --out"
    )
