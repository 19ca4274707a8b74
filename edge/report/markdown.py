"""Tables as Markdown."""

from __future__ import annotations

from edge.report.rows import Table


def markdown_table(table: Table) -> str:
    """A Markdown table with its title as a heading and its note below; ends with a blank line."""
    if not table.rows:
        return ""
    lines = [f"### {table.title}", "", _row(table.columns), _row(tuple("---" for _ in table.columns))]
    lines += [_row(row) for row in table.rows]
    if table.note:
        lines += ["", table.note]
    return "\n".join(lines) + "\n\n"


def _row(cells: tuple[str, ...]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
