"""The one error that is this room's own."""

from __future__ import annotations

from runtime.contracts.errors import EdgeError


class ExportError(EdgeError):
    """A network cannot be written as a finished graph."""
