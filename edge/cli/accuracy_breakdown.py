"""``edge accuracy --by`` and ``--pictures``: where objects are found and missed, and what the misses look like."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edge.evaluation.breakdown import Breakdown
    from edge.evaluation.run import ModelRun
    from runtime.sources.base import FrameSequence


def kinds_of(by: str | None) -> tuple[str, ...]:
    """The kinds of bands that ``--by`` names; none where it was not given.

    Raises:
        FormatError: one is unknown, given twice, or none is named.
    """
    from edge.evaluation.breakdown import KINDS
    from runtime.contracts.errors import FormatError

    if by is None:
        return ()
    kinds = tuple(word.strip() for word in by.split(",") if word.strip())
    if not kinds or len(set(kinds)) < len(kinds) or not set(kinds) <= set(KINDS):
        raise FormatError(f"--by: found {by!r}; expected some of {', '.join(KINDS)}; separate them by commas")
    return kinds


def need_labels(frames: FrameSequence, option: str) -> None:
    """Say it before a model runs for minutes.

    Raises:
        SourceError: no frame has labels.
    """
    from runtime.contracts.errors import SourceError

    if all(frames.labels(index) is None for index in range(len(frames))):
        raise SourceError(
            f"{option}: found no labels in {frames.uri}; expected labelled frames; name others or leave it out"
        )


def broken_down(run: ModelRun, kinds: Sequence[str]) -> Breakdown:
    """A run's labelled frames, split."""
    from edge.evaluation.breakdown import break_down
    from edge.evaluation.measure import labelled_frames

    rows = labelled_frames(run)
    labels = [item for item in run.labels if item is not None]
    found = [run.detections[index] for index in rows]
    return break_down(labels, found, score=run.score_display, classes=run.classes, kinds=kinds)


def draw_errors(folder: Path, frames: FrameSequence, run: ModelRun, found: Breakdown, *, top: int) -> int:
    """Writes the pictures; gives their number."""
    from edge.evaluation.measure import labelled_frames
    from edge.report.error_pictures import write_error_pictures

    return len(write_error_pictures(folder, frames, run, found.outcomes, labelled_frames(run), limit=top))


def with_breakdowns(record: dict[str, Any], found: Sequence[Breakdown]) -> dict[str, Any]:
    """The record of ``--json`` with a ``breakdown`` of each model."""
    from edge.report.breakdown import breakdown_record

    for branch, item in zip(record["models"], found, strict=False):
        branch["breakdown"] = breakdown_record(item)
    return record
