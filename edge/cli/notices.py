"""Warnings of the libraries on stderr, held back until the command is known to work.

A command that fails says one line, its error; what was noticed on the way would only blur it.
"""

from __future__ import annotations

import logging
import sys
from types import TracebackType
from typing import Self


class Notices(logging.Handler):
    """Takes the warnings of a logger while entered; shows each text once, after `release`."""

    def __init__(self, logger_name: str = "runtime") -> None:
        """Chooses the logger, by default that of the whole runtime."""
        super().__init__(level=logging.WARNING)
        self._logger = logging.getLogger(logger_name)
        self._held: list[str] = []
        self._shown: set[str] = set()
        self._open = False

    def __enter__(self) -> Self:
        """Starts taking warnings."""
        self._propagated = self._logger.propagate
        self._logger.propagate = False
        self._logger.addHandler(self)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Stops; after success whatever is still held is shown."""
        if error is None:
            self.release()
        self._logger.removeHandler(self)
        self._logger.propagate = self._propagated

    def emit(self, record: logging.LogRecord) -> None:
        """Hold or show one warning."""
        self._held.append(record.getMessage())
        if self._open:
            self.release()

    def release(self) -> None:
        """Show what is held, and from now on everything at once."""
        self._open = True
        for text in self._held:
            if text not in self._shown:
                self._shown.add(text)
                sys.stderr.write(f"note: {text}\n")
        self._held.clear()
