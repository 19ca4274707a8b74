"""What a report shows beside its figures: boxes of both models in pictures, AP by distance, ranges of layers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from edge.evaluation.depth_error import depth_errors
from edge.evaluation.distance import ap_by_distance
from edge.evaluation.run import ModelRun
from edge.report.changes import changes_of, changes_table, write_pictures
from edge.report.document import depth_table
from edge.report.histograms import RangePlot, write_range_plots
from edge.report.rows import Table
from runtime.model_folder import RANGES_PLOT, REPORT_PICTURES
from runtime.sources.base import FrameSequence

PICTURES = 6


@dataclass(frozen=True, slots=True)
class Evidence:
    """Tables, pictures (caption, path) and the same as a record for report.json."""

    tables: tuple[Table, ...] = ()
    pictures: tuple[tuple[str, str], ...] = ()
    record: dict[str, Any] | None = None


def collect_evidence(
    folder: Path, frames: FrameSequence, runs: tuple[ModelRun, ModelRun], plots: Sequence[RangePlot]
) -> Evidence:
    """Draw the pictures into ``folder`` and make the tables; float first.

    Raises:
        OutputError: the folder cannot be written.
    """
    first, second = runs
    names = ("float32", "INT8")
    drawn = write_pictures(
        folder, frames, reference=first, other=second, names=names, limit=PICTURES, folder=REPORT_PICTURES
    )
    changes = changes_of(first, second, {frame: path for frame, _, path in drawn})
    tables = [changes_table(changes)]
    record: dict[str, Any] = {"changes": [asdict(item) for item in changes]}
    rows = [index for index, labels in enumerate(first.labels) if labels is not None]
    if rows:
        labels = [item for item in first.labels if item is not None]
        found = [[run.detections[index] for index in rows] for run in runs]
        for name, run, boxes in zip(names, runs, found, strict=True):
            errors = depth_errors(labels, boxes, score=run.score_display)
            tables.append(depth_table(errors, title=f"{name}: depth and centre error against the labels, by distance"))
        distances = ap_by_distance(labels, *found, first.classes)
        record["ap_by_distance"] = [asdict(item) for item in distances]
        cells = tuple(
            (
                item.name,
                item.band,
                str(item.objects),
                f"{item.reference:.2f}",
                f"{item.other:.2f}",
                f"{item.drop:+.2f} [{item.interval95[0]:+.1f}, {item.interval95[1]:+.1f}]",
            )
            for item in distances
        )
        columns = ("class", "distance m", "objects", "float32", "INT8", "points lost")
        tables.insert(0, Table("3D AP R40 moderate by distance", columns, cells))
    pictures = [(caption, path) for _, caption, path in drawn]
    if plots:
        try:
            write_range_plots(folder / RANGES_PLOT, plots)
            pictures.append(("Values of the noisiest layers; red: the range that 8 bits cover", RANGES_PLOT))
        except ImportError:
            record["ranges_picture"] = "left out: matplotlib is missing"
    return Evidence(tuple(tables), tuple(pictures), record)
