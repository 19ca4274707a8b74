"""``edge stream``: a model over a source, frame by frame, to JSON lines, KITTI text, video and pictures."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from runtime.contracts.errors import EdgeError, SourceError

if TYPE_CHECKING:
    from rich.console import Console

    from runtime.pipeline import StreamReport
    from runtime.sinks.base import FrameResult, Sink
    from runtime.sources.base import Source

EXIT_INTERRUPTED = 130
STANDARD_OUTPUT = "-"


def stream_command(
    model: Annotated[Path, typer.Argument(metavar="MODEL_DIR", help="Model directory.")],
    source: Annotated[str, typer.Option(metavar="URI", help="Where the pairs come from, e.g. kitti-raw:DRIVE.")],
    json: Annotated[
        str | None, typer.Option(metavar="FILE", help="JSON lines, one a frame; - for standard output.")
    ] = None,
    kitti: Annotated[Path | None, typer.Option(metavar="DIR", help="KITTI text, one file a frame.")] = None,
    video: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Boxes on the image beside a bird's-eye view; .mp4 .avi .webm.")
    ] = None,
    pictures: Annotated[Path | None, typer.Option(metavar="DIR", help="The same as pictures.")] = None,
    labels: Annotated[bool, typer.Option("--labels", help="Draw the source's labels as thin white boxes.")] = False,
    score: Annotated[
        float | None, typer.Option(min=0.001, max=0.999, help="Least score; the model's display threshold if left out.")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of the model; all cores if left out.")] = None,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace results that are there.")] = False,
) -> None:
    """Run a model over a recording or a camera and write its 3D boxes."""
    from runtime.sources.factory import open_source

    frames = open_source(source)  # before all that takes time: a camera that is not there is told at once

    from rich.console import Console

    from edge.cli.notices import Notices
    from runtime.contracts.manifest import open_model_directory
    from runtime.detector import open_detector
    from runtime.pipeline import run_stream
    from runtime.sinks.factory import SinkRequest, open_sinks

    directory = open_model_directory(model)
    if labels and frames.is_live:
        raise SourceError(f"{source} is live and has no labels, expected recorded frames; leave --labels out")
    if labels and video is None and pictures is None:
        raise EdgeError("--labels draws labels, expected --video or --pictures beside it; add one or leave it out")
    request = SinkRequest(json=json, kitti=kitti, video=video, pictures=pictures, overwrite=overwrite)
    sinks = open_sinks(request, directory.manifest, fps=frames.frame_hz)
    with ExitStack() as stack:
        notices = stack.enter_context(Notices())
        detector = stack.enter_context(open_detector(directory, threads=threads, allow_other_rig=allow_other_rig))
        stack.enter_context(frames)
        for sink in sinks:
            stack.enter_context(sink)
        on_result = stack.enter_context(_progress(frames, first=notices.release))
        report = run_stream(
            frames,
            detector,
            sinks,
            score=directory.manifest.thresholds.display if score is None else score,
            with_labels=labels,
            on_result=on_result,
        )
    _tell(Console(stderr=json == STANDARD_OUTPUT), report, sinks)
    if report.interrupted:
        raise typer.Exit(EXIT_INTERRUPTED)


@contextmanager
def _progress(frames: Source, *, first: Callable[[], None]) -> Iterator[Callable[[FrameResult], None]]:
    """A progress bar on a terminal; ``first`` is called before the first step."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    from runtime.sources.base import FrameSequence

    total = len(frames) if isinstance(frames, FrameSequence) else None
    columns = (
        TextColumn("frame"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[what]}"),
    )
    with Progress(*columns, console=Console(stderr=True), disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task("frames", total=total, what="")

        def step(result: FrameResult) -> None:
            first()
            bar.update(task, advance=1, what=f"{len(result.detections)} boxes, {result.latency_ms['total']:.0f} ms")

        yield step


def _tell(console: Console, report: StreamReport, sinks: list[Sink]) -> None:
    """The table of latencies and what was written where."""
    from rich.table import Table

    table = Table(title="Latency in ms")
    table.add_column("stage")
    for heading in ("p50", "p90", "p99", "max"):
        table.add_column(heading, justify="right")
    for stage, figures in report.latency.summary().items():
        values = (figures.p50, figures.p90, figures.p99, figures.largest)
        table.add_row(stage, *(f"{value:.1f}" for value in values), style="bold" if stage == "total" else None)
    console.print(table)
    line = f"{report.frames} frames, {report.detections} boxes, {report.frames_per_second:.1f} frames a second"
    if report.dropped:
        line += f", {report.dropped} stale frames dropped"
    if report.interrupted:
        line += ", interrupted"
    console.print(line, highlight=False)
    for sink in sinks:
        console.print(f"written: {sink.summary()}", highlight=False, soft_wrap=True, markup=False)
