"""``edge accuracy``: models side by side on one source, the first is the reference."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edge.cli.accuracy_breakdown import broken_down, draw_errors, kinds_of, need_labels, with_breakdowns
from edge.cli.calibration_overlap import warn_of_calibrated
from edge.cli.stages import warn

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edge.evaluation.measure import Assessment
    from runtime.contracts.measurement import Measurement
    from runtime.sources.base import FrameSequence

DETECTIONS_FOLDER = "detections"
PICTURES = 6
ERROR_PICTURES = 20


def accuracy_command(
    models: Annotated[list[Path], typer.Argument(help="Model directories; the first is the reference.")],
    source: Annotated[str, typer.Option(help="Frames to measure on, for example kitti-object:ROOT?split=val.")],
    out: Annotated[Path | None, typer.Option(help="New folder for report, pictures and detections.")] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures to this file.")] = None,
    results: Annotated[
        Path | None,
        typer.Option(help="New folder for KITTI's test server: a text file a frame, and results.zip; one model."),
    ] = None,
    by: Annotated[
        str | None,
        typer.Option(help="Split AP, recall, misses and inventions: distance, occlusion, truncation; comma between."),
    ] = None,
    pictures: Annotated[
        Path | None, typer.Option(help="New folder for pictures of what is missed and invented; of one model.")
    ] = None,
    top: Annotated[int, typer.Option(min=1, help="How many pictures of each.")] = ERROR_PICTURES,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace results that are there.")] = False,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
) -> None:
    """AP of each model, what the others lose against the first, and how far they agree with it."""
    from edge.evaluation.measure import assess, measurement
    from edge.evaluation.run import run_model
    from edge.evaluation.submission import check_frame_names, write_submission
    from edge.report.breakdown import breakdown_tables
    from edge.report.document import NO_LABELS, model_names, report_tables
    from edge.report.files import write_json
    from edge.report.records import accuracy_record
    from edge.report.terminal import progress_bar, report_console, show_table
    from runtime.contracts.errors import OutputError
    from runtime.contracts.manifest import open_model_directory
    from runtime.sinks.places import claim_file, claim_folder
    from runtime.sources.base import as_sequence
    from runtime.sources.factory import open_source

    kinds = kinds_of(by)
    for path in models:
        open_model_directory(path)  # a wrong one is said before the first has run for minutes
    if results is not None and len(models) > 1:
        raise OutputError(f"--results with {len(models)} models, expected one; leave the others out")
    if pictures is not None and len(models) > 1:
        raise OutputError(f"--pictures with {len(models)} models, expected one; leave the others out")
    for folder in (out, results, pictures):
        if folder is not None:
            claim_folder(folder, overwrite=overwrite)
    if json is not None:
        claim_file(json, overwrite=overwrite)
    with open_source(source) as opened:
        frames = as_sequence(opened)
        if kinds or pictures is not None:
            need_labels(frames, "--by" if kinds else "--pictures")
        if results is not None:  # before the model runs for minutes
            check_frame_names([frames.frame_id(index) for index in range(len(frames))])
        warn_of_calibrated(models, frames, uri=source)
        assessments: list[Assessment] = []
        for path in models:
            with progress_bar(f"{path}", len(frames)) as step:
                run = run_model(path, frames, on_frame=step, allow_other_rig=allow_other_rig, warn=warn)
            assessments.append(assess(run))
        records = [measurement(item, assessments[0] if index else None) for index, item in enumerate(assessments)]
        splits = [broken_down(item.run, kinds) for item in assessments] if kinds or pictures is not None else []
        if json is not None:
            write_json(json, with_breakdowns(accuracy_record(records), splits if kinds else []))
        drawn = 0 if pictures is None else draw_errors(pictures, frames, assessments[0].run, splits[0], top=top)
        if results is not None:
            write_submission(results, assessments[0].run.frame_ids, assessments[0].run.detections)
        if out is not None:
            _write_folder(out, source, frames, assessments=assessments, records=records)

    console = report_console()
    if assessments[0].evaluation is None:
        console.print(NO_LABELS)
    elif assessments[0].evaluation.frames < len(frames):
        console.print(f"{assessments[0].evaluation.frames} of {len(frames)} frames have labels; AP is on those.")
    for table in report_tables(records):
        show_table(console, table)
    for name, split in zip(model_names(records), splits, strict=False):
        for table in breakdown_tables(split, name=name):
            show_table(console, table, text_columns=2)
    if pictures is not None:
        console.print(f"{drawn} pictures of missed and invented objects are in {pictures}.", soft_wrap=True)
    if out is not None:
        console.print(f"Report, pictures and detections are in {out}.", soft_wrap=True)
    if results is not None:
        console.print(f"Results for the test server are in {results}.", soft_wrap=True)


def _write_folder(
    out: Path,
    source: str,
    frames: FrameSequence,
    *,
    assessments: Sequence[Assessment],
    records: Sequence[Measurement],
) -> None:
    """Detections as KITTI text, pictures of differences, report.md and report.json."""
    from edge.evaluation.depth_error import depth_errors
    from edge.evaluation.measure import labelled_frames
    from edge.report.changes import write_pictures
    from edge.report.document import model_names
    from edge.report.files import write_text
    from edge.report.model_report import write_model_report
    from runtime.contracts.kitti import format_detections

    names = model_names(records)
    for name, item in zip(names, assessments, strict=True):
        folder = out / DETECTIONS_FOLDER / _flat(name)
        for frame_id, found in zip(item.run.frame_ids, item.run.detections, strict=True):
            write_text(folder / f"{frame_id}.txt", format_detections(found))
        older = sum(1 for _ in folder.rglob("*.txt")) - len(item.run.frame_ids)
        if older:
            warn(f"{folder}: {older} text files of an earlier run lie among those of these frames; remove what is old")
    errors = []
    for item in assessments:
        rows = labelled_frames(item.run)
        labels = [item.run.labels[index] for index in rows]
        found = [item.run.detections[index] for index in rows]
        errors.append(depth_errors(labels, found, score=item.run.score_display))
    pictures: list[tuple[str, str]] = []
    for name, item in zip(names[1:], assessments[1:], strict=True):
        written = write_pictures(
            out,
            frames,
            reference=assessments[0].run,
            other=item.run,
            names=(names[0], name),
            limit=PICTURES,
            subfolder=_flat(name),
        )
        pictures += [(caption, place) for _, caption, place in written]
    write_model_report(
        out,
        records,
        title=f"Accuracy of {', '.join(names)}",
        source=source,
        depth_errors=errors,
        pictures=pictures,
    )


def _flat(name: str) -> str:
    """A name as one part of a path."""
    return re.sub(r"[^\w.-]+", "_", name).strip("_")
