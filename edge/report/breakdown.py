"""Where a model finds and misses objects, as tables and as a record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from edge.evaluation.breakdown import BANDS, DISTANCE, BandRow, Breakdown
from edge.evaluation.outcomes import INVENTED_REASONS, MISSED_REASONS
from edge.report.rows import NO_VALUE, Table

UNITS = {DISTANCE: "distance m"}
ABOUT_RECALL = (
    "Recall at the display score, with the 95 % interval over frames; AP is 3D R40 of all objects of the band from 25 "
    "pixels on, at IoU 0.5 for cars and 0.25 for others. Misplaced: seen in the image, wrong in space."
)
ABOUT_SHARED = " An invention is neither occluded nor truncated and counts in each band: AP of a small band is low."


def breakdown_tables(found: Breakdown, *, name: str) -> list[Table]:
    """One table a kind of band, and one of the inventions.

    Args:
        found: of one model.
        name: of the model.
    """
    kinds = list(dict.fromkeys(row.kind for row in found.rows))
    tables = [_recall_table([row for row in found.rows if row.kind == kind], kind, name) for kind in kinds]
    if DISTANCE in kinds:
        tables.append(_invention_table(found, name))
    return [table for table in tables if table.rows]


def breakdown_record(found: Breakdown) -> dict[str, Any]:
    """For JSON: the score, all rows, and the number of frames behind them."""
    return {
        "score": found.score,
        "frames": found.outcomes.frames,
        "rows": [asdict(row) for row in found.rows],
    }


def _recall_table(rows: Sequence[BandRow], kind: str, name: str) -> Table:
    cells = tuple(
        (
            row.name,
            row.band,
            str(row.objects),
            str(row.found),
            _recall(row),
            f"{100 * row.recall_any:.1f}" if row.objects else NO_VALUE,
            f"{row.ap:.1f}" if row.objects else NO_VALUE,
            *(str(row.missed[reason]) for reason in MISSED_REASONS),
        )
        for row in rows
        if row.objects
    )
    columns = ("class", UNITS.get(kind, kind), "objects", "found", "recall %", "at any score %", "AP", *MISSED_REASONS)
    note = ABOUT_RECALL + ("" if kind == DISTANCE else ABOUT_SHARED)
    return Table(f"{name}: objects found and missed by {kind}", columns, cells, note=note)


def _recall(row: BandRow) -> str:
    low, high = row.recall_interval95
    return f"{100 * row.recall:.1f} [{100 * low:.0f}, {100 * high:.0f}]"


def _invention_table(found: Breakdown, name: str) -> Table:
    frames = max(found.outcomes.frames, 1)
    rows = []
    for row in (row for row in found.rows if row.kind == DISTANCE and row.invented):
        total = sum(row.invented.values())
        counts = (str(row.invented[reason]) for reason in INVENTED_REASONS)
        rows.append((row.name, row.band, str(total), f"{total / frames:.2f}", *counts))
    columns = ("class", UNITS[DISTANCE], "inventions", "a frame", *INVENTED_REASONS)
    note = (
        f"Detections from the display score {found.score:g} on that find no object, by their own distance "
        f"({', '.join(BANDS[DISTANCE])} m), on {found.outcomes.frames} frames."
    )
    return Table(f"{name}: inventions by distance", columns, tuple(rows), note=note)
