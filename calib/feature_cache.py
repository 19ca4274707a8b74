"""Remembers rows of features by the frames that they describe, so that a pool is not looked at twice."""

from __future__ import annotations

import hashlib
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from calib.cache import UNREADABLE, cache_folder, write_arrays

_KEPT_ROWS = 8192

Number = type[np.float32] | type[np.uint32]


def feature_folder() -> Path:
    """Where rows are kept, beside the observations."""
    return cache_folder().parent / "features"


class FeatureCache:
    """Rows of one method by the hash of a frame; a context manager that keeps new ones when left without an error.

    An unreadable file counts as absent, and a folder that cannot be written is left alone.
    """

    def __init__(
        self, method: str, *, enabled: bool = True, folder: Path | None = None, number: Number = np.float32
    ) -> None:
        """Names the rows.

        Args:
            method: All that a row depends on beside the frame: the version of the features, the model.
            enabled: Whether to read and keep anything.
            folder: Where; None for the user's cache folder.
            number: What rows are made of.
        """
        name = hashlib.sha256(method.encode()).hexdigest()[:32]
        self._path = (folder or feature_folder()) / f"{name}.npz"
        self._enabled = enabled
        self._number = number
        self._rows: dict[str, NDArray[Any]] = {}
        self._new = False

    def __enter__(self) -> Self:
        """Reads what is kept."""
        if self._enabled:
            try:
                with self._path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
                    names, rows = archive["names"], archive["rows"].astype(self._number)
                    if rows.ndim == 2 and np.isfinite(rows).all():
                        self._rows = {str(name): row for name, row in zip(names, rows, strict=True)}
            except UNREADABLE:
                self._rows = {}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Keeps the newest rows."""
        if not (self._enabled and self._new and error is None):
            return
        kept = list(self._rows.items())[-_KEPT_ROWS:]
        rows = np.array([row for _, row in kept], self._number)
        write_arrays(self._path, {"names": np.array([name for name, _ in kept], np.str_), "rows": rows})

    def get(self, key: str, *, size: int) -> NDArray[Any] | None:
        """The row of a frame, or None where it is not known or has another size."""
        row = self._rows.get(key)
        return row if row is not None and len(row) == size else None

    def put(self, key: str, row: NDArray[Any]) -> None:
        """Remembers a row."""
        self._rows.pop(key, None)  # the newest last
        self._rows[key] = row
        self._new = True
