"""``edge evaluate``: KITTI average precision of result files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def evaluate_command(
    labels: Annotated[Path, typer.Option(help="Folder of KITTI label files, FRAME.txt.")],
    detections: Annotated[Path, typer.Option(help="Folder of KITTI result files, FRAME.txt; empty: no detection.")],
    split: Annotated[
        Path | None, typer.Option(help="Frames to evaluate, one id a line; default: the result files.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the AP tree to this file.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace that file if it is there.")] = False,
) -> None:
    """KITTI AP (2D, bird's eye, 3D, orientation; R40 and R11) of result files."""
    from edge.evaluation.kitti_ap import evaluate
    from edge.evaluation.text_folders import read_text_frames
    from edge.report.files import write_json
    from edge.report.rows import ap_table
    from edge.report.terminal import report_console, show_table
    from runtime.sinks.places import claim_file

    if json is not None:
        claim_file(json, overwrite=overwrite)
    frames = read_text_frames(labels, detections, split)
    evaluation = evaluate(frames.labels, frames.detections)
    ap = evaluation.ap()
    if json is not None:
        write_json(json, ap)
    found = sum(len(item) for item in frames.detections)
    title = f"KITTI AP in per cent: {evaluation.frames} frames, {found} detections"
    show_table(report_console(), ap_table(ap, evaluation.objects, title=title))
