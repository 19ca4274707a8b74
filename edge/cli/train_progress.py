"""What ``edge train`` shows while it runs, and the picture of its log."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from edge.training.run_record import RunSettings


class TrainProgress:
    """A bar over the steps; a context manager.

    Args:
        settings: of the run.
        samples: an epoch.
        shown: False for processes that stay silent.
    """

    def __init__(self, settings: RunSettings, *, samples: int, shown: bool) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        self._console = Console(stderr=True, quiet=not shown)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=self._console)
        self._task = self._bar.add_task("training", total=settings.steps)
        self._console.print(f"{samples} samples an epoch, {settings.batch_size} a step, {settings.steps} steps")

    def __enter__(self) -> Self:
        """Shows the bar."""
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Takes it away."""
        self._bar.stop()

    def tell(self, *lines: str) -> None:
        """Say something before the bar."""
        for line in lines:
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)

    def step(self, step: int, losses: dict[str, float]) -> None:
        """Move on."""
        total = losses["class_loss"] + losses["box_loss"]
        self._bar.update(self._task, completed=step, description=f"training, loss {total:.3f}")

    def finish(self, run_dir: Path) -> None:
        """Draw the log, and say what was written."""
        from edge.training.event_log import is_available
        from edge.training.log_plot import plot_log

        plot_log(run_dir / "log.csv", run_dir / "log.png")
        self._console.print(f"wrote {run_dir / 'weights.safetensors'}")
        if not is_available():
            self._console.print("no event files: they need tensorboardX; run: pip install '.[train]'")
