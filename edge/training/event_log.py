"""Event files that TensorBoard shows: ``tensorboard --logdir RUN``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

EVENTS_FOLDER = "events"


class EventLog:
    """Scalars by step; a context manager. Without tensorboardX (extra ``train``) it writes nothing.

    Args:
        run_dir: the files go into its folder ``events``.
        first_step: what an earlier, interrupted part of the run logged from here on is hidden.
        enabled: False for processes that do not write.
    """

    def __init__(self, run_dir: Path, *, first_step: int = 0, enabled: bool = True) -> None:
        self._writer: Any = None
        if enabled and is_available():
            from tensorboardX import SummaryWriter

            purge = {"purge_step": first_step + 1} if first_step else {}
            suffix = f".{first_step}"  # names have whole seconds: a run resumed at once would overwrite its own file
            self._writer = SummaryWriter(str(run_dir / EVENTS_FOLDER), filename_suffix=suffix, **purge)

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Writes what is pending."""
        if self._writer is not None:
            self._writer.close()

    def add(self, step: int, scalars: Mapping[str, float]) -> None:
        """Log numbers by tag, such as ``train/box_loss``."""
        if self._writer is not None:
            for tag, value in scalars.items():
                self._writer.add_scalar(tag, value, step)


def is_available() -> bool:
    """Whether the package that writes event files is installed."""
    from importlib.util import find_spec

    return find_spec("tensorboardX") is not None
