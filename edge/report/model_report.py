"""report.md and report.json of a model directory or of a comparison."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge.evaluation.depth_error import DepthError
from edge.report.document import report_text
from edge.report.files import write_json, write_text
from edge.report.records import report_record
from runtime.contracts.measurement import Measurement
from runtime.model_folder import REPORT_RECORD, REPORT_TEXT


def write_model_report(
    folder: Path,
    measurements: Sequence[Measurement],
    *,
    title: str,
    source: str,
    facts: dict[str, str] | None = None,
    depth_errors: Sequence[dict[str, dict[str, DepthError]]] = (),
    pictures: Sequence[tuple[str, str]] = (),
) -> None:
    """Write ``report.md`` and ``report.json``.

    Args:
        folder: model directory, or the folder of a comparison.
        measurements: the first is the reference (for a quantised model: the float one), the others are
            compared with it.
        title: heading, for example the model's name.
        source: URI of the measured frames.
        facts: what else belongs at the top (recipe, calibration frames, machine).
        depth_errors: of each model; may be left out.
        pictures: caption and path relative to the folder.

    Raises:
        OutputError: the folder cannot be written.
    """
    record = report_record(measurements, source=source, depth_errors=depth_errors, facts=facts)
    write_json(folder / REPORT_RECORD, record)
    write_text(
        folder / REPORT_TEXT,
        report_text(
            measurements, title=title, source=source, facts=facts, depth_errors=depth_errors, pictures=pictures
        ),
    )
