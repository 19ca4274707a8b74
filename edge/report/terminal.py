"""Tables and progress on the terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table as RichTable
from rich.text import Text

from edge.report.rows import Table

TEXT_COLUMNS = 3
MIN_WIDTH = 140  # piped output has no width of its own: do not fold the tables


def show_table(console: Console, table: Table, *, text_columns: int = TEXT_COLUMNS) -> None:
    """Print a table.

    Args:
        console: where to.
        table: what.
        text_columns: leading columns that hold words; the others are aligned right.
    """
    if not table.rows:
        return
    grid = _grid(table, len(table.columns), text_columns)
    if (
        table.spare_columns
        and Measurement.get(console, console.options.update(max_width=10_000), grid).maximum > console.width
    ):
        grid = _grid(table, len(table.columns) - table.spare_columns, text_columns)
    console.print(grid)
    if table.note:
        console.print(Text(table.note))


def _grid(table: Table, columns: int, text_columns: int) -> RichTable:
    grid = RichTable(title=Text(table.title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for index, name in enumerate(table.columns[:columns]):
        grid.add_column(Text(name), justify="left" if index < text_columns else "right", no_wrap=True)
    for row in table.rows:
        grid.add_row(*(Text(cell) for cell in row[:columns]))
    return grid


class _ReportConsole(Console):
    def on_broken_pipe(self) -> None:
        """Raise what rich would end the process for, so that the exit code is one place's business."""
        raise BrokenPipeError


def report_console() -> Console:
    """A console for results: standard output, wide enough for the tables where it is piped."""
    console = _ReportConsole(highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console.width = max(console.width, MIN_WIDTH)
    return console


@contextmanager
def progress_bar(title: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on standard error; gives the function to call after each step. Silent where that is no terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        task = progress.add_task(escape(title), total=total)
        yield lambda: progress.advance(task)
