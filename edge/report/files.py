"""Writes result files: beside their place first, then renamed, so that a reader never sees half of one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from runtime.contracts.errors import OutputError


def write_json(path: Path, record: Any) -> None:
    """Write a record as JSON.

    Raises:
        OutputError: the place cannot be written.
    """
    write_text(path, json.dumps(record, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write text.

    Raises:
        OutputError: the place cannot be written.
    """
    beside = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise OutputError(
            f"{path} cannot be written ({reason}), expected a writable place; choose another"
        ) from None
