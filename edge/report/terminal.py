"""Tables on the terminal."""

from __future__ import annotations

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from edge.report.rows import Table

TEXT_COLUMNS = 3
MIN_WIDTH = 120  # piped output has no width of its own: do not fold the tables


def show_table(console: Console, table: Table, *, text_columns: int = TEXT_COLUMNS) -> None:
    """Print a table.

    Args:
        console: where to.
        table: what.
        text_columns: leading columns that hold words; the others are aligned right.
    """
    if not table.rows:
        return
    grid = RichTable(title=Text(table.title), box=box.SIMPLE_HEAD, title_justify="left", pad_edge=False)
    for index, name in enumerate(table.columns):
        grid.add_column(Text(name), justify="left" if index < text_columns else "right", no_wrap=True)
    for row in table.rows:
        grid.add_row(*(Text(cell) for cell in row))
    console.print(grid)
    if table.note:
        console.print(Text(table.note))


def report_console() -> Console:
    """A console for results: standard output, wide enough for the tables where it is piped."""
    console = Console(highlight=False, soft_wrap=False)
    if not console.is_terminal:
        console.width = max(console.width, MIN_WIDTH)
    return console
