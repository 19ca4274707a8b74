"""Where the built operator library lies, and what it would run on this machine."""

from __future__ import annotations

import ctypes
import os
from importlib.resources import files
from pathlib import Path

from runtime.native.build import LIBRARY_NAME

ENVIRONMENT_SWITCH = "EDGE_NATIVE"


def is_wanted() -> bool:
    """Whether the library may be used: ``EDGE_NATIVE=0`` in the environment turns it off."""
    return os.environ.get(ENVIRONMENT_SWITCH, "1") != "0"


def library_path() -> Path | None:
    """Finds the library of the installed or editable package.

    Returns:
        Its path, or None where it was not built (no compiler at install time) or lies in an archive.
    """
    resource = files("runtime.native").joinpath(LIBRARY_NAME)
    path = Path(str(resource))
    return path if path.is_file() else None


def instruction_set() -> str | None:
    """Asks the library which kernels new sessions would use: ``vnni``, ``avx512``, ``avx2``, ``neon`` or ``scalar``.

    Returns:
        The name; None where the library is not built, cannot be loaded, or ``EDGE_NATIVE_ISA`` names an
        instruction set that this machine lacks.
    """
    path = library_path()
    if path is None:
        return None
    try:
        ask = ctypes.CDLL(str(path)).EdgeStereoInstructionSet
    except (OSError, AttributeError):
        return None
    ask.restype = ctypes.c_char_p
    name: bytes | None = ask()
    return None if name is None else name.decode()
