"""Bars of the long stages, and lines said on the way: all on standard error."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import typer


@contextmanager
def stage_progress() -> Iterator[Callable[[str, int, int], None]]:
    """Bars on standard error, one a stage; silent where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield tell


def say(text: str) -> None:
    """One line about what happens."""
    typer.echo(text, err=True)


def warn(text: str) -> None:
    """One line about what is odd; the command goes on."""
    typer.echo(f"warning: {text}", err=True)
