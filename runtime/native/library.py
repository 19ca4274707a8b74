"""Where the built library lies, what it would run on this machine, and its functions beside the operators."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from runtime.native.build import LIBRARY_NAME

ENVIRONMENT_SWITCH = "EDGE_NATIVE"


RecordCall = Callable[..., bool]
"""Takes the records of a function of the library; False, and nothing done, where it is of another build."""


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


def record_call(symbol: str) -> RecordCall | None:
    """A function of the library that takes records, each by its address and length.

    Returns:
        It; None where the library is not built or not wanted, cannot be loaded, or is an older one that lacks it.
    """
    path = library_path() if is_wanted() else None
    function = None if path is None else _function(path, symbol)
    if function is None:
        return None

    def call(*records: ctypes.Structure) -> bool:
        arguments = [
            part for record in records for part in (ctypes.byref(record), ctypes.c_int64(ctypes.sizeof(record)))
        ]
        return bool(function(*arguments))

    return call


@cache
def _function(path: Path, symbol: str) -> Any:
    try:
        function = getattr(ctypes.CDLL(str(path)), symbol)
    except (OSError, AttributeError):
        return None
    function.restype = ctypes.c_bool
    return function
