"""Where the built operator library lies."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from runtime.native.build import LIBRARY_NAME


def library_path() -> Path | None:
    """Finds the library of the installed or editable package.

    Returns:
        Its path, or None where it was not built (no compiler at install time) or lies in an archive.
    """
    resource = files("runtime.native").joinpath(LIBRARY_NAME)
    path = Path(str(resource))
    return path if path.is_file() else None
