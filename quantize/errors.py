"""The one error that is this room's own."""

from __future__ import annotations

from runtime.contracts.errors import EdgeError


class QuantizeError(EdgeError):
    """A model or a recipe cannot be quantised as asked."""
