"""``edge quantize``: a float model directory to an INT8 one, with a report, and within an accuracy budget if asked."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from calib.methods import Range
    from quantize.bias_correction import Shifts
    from quantize.budget import BudgetResult
    from quantize.static import Calibration, Prepared
    from runtime.contracts.manifest import ModelDirectory
    from runtime.contracts.measurement import Measurement

DEFAULT_FRAMES = 100
NOISE_FRAMES, RANKING_FRAMES, TIMED_FRAMES, TIMED_REPEAT = 2, 2, 4, 3
REFINEMENTS = 4
"""Layers given back that are tried in INT8 again; each costs one run over the validation frames."""
PLOTTED_LAYERS = 6
REPORT_FRAMES = 20
"""Frames of the bundled drive that the report measures; a --validation source is measured whole."""


class Method(StrEnum):
    """How ranges follow from the values that were seen."""

    MINMAX = "minmax"
    PERCENTILE = "percentile"
    MSE = "mse"
    ENTROPY = "entropy"


def quantize_command(
    model: Annotated[Path, typer.Argument(help="Float model directory of `edge export`.")],
    out: Annotated[Path, typer.Option(help="Model directory to write; an older one there is replaced.")],
    calibration: Annotated[
        str | None, typer.Option(help="Frames that show the ranges; default: the bundled calibration drive.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many of them, spread over the source.")] = DEFAULT_FRAMES,
    target: Annotated[
        str | None,
        typer.Option(help="x86-vnni, x86-avx2, arm64, generic, openvino or tensorrt; default: this machine."),
    ] = None,
    method: Annotated[Method, typer.Option(help="Range method.")] = Method.MSE,
    validation: Annotated[
        str | None, typer.Option(help="Frames to measure on; default: the bundled measuring drive.")
    ] = None,
    max_drop: Annotated[
        float | None, typer.Option(help="Points of 3D AP that may be lost; layers go back to float until it holds.")
    ] = None,
    max_disagreement: Annotated[
        float | None,
        typer.Option(help="The budget without labels: per cent of detections that may differ from the float model's."),
    ] = None,
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Neither use nor keep earlier calibrations.")] = False,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
) -> None:
    """Quantise a model; exit 1 where the accuracy budget cannot be kept."""
    import time

    from edge.report.terminal import report_console, show_table
    from edge.samples import calibration_source
    from quantize.errors import QuantizeError
    from quantize.recipe import detect_target, recipe_for_target
    from quantize.static import build, calibrate, corrections, equalised, prepare_model, write_directory
    from runtime.contracts.errors import GoalMissedError
    from runtime.contracts.manifest import open_model_directory
    from runtime.sources.factory import open_sequence

    if max_drop is not None and validation is None:
        raise QuantizeError("--max-drop: found no --validation; expected labelled frames to measure on; name a source")
    if max_disagreement is not None and (validation is None or max_drop is not None):
        found_instead = "no --validation" if validation is None else "--max-drop, too"
        raise QuantizeError(
            f"--max-disagreement: found {found_instead}; expected a source to measure on, and one budget; "
            "--max-drop is for labelled frames"
        )
    budget = max_drop if max_drop is not None else max_disagreement
    began_secs = time.perf_counter()
    directory = open_model_directory(model)
    recipe = recipe_for_target(target or detect_target())
    prepared = prepare_model(directory, recipe)
    if prepared.pixel_note is not None:
        _say(f"pixels are normalised in float: {prepared.pixel_note}")
    if calibration is None:
        _say("no --calibration: ranges come from the bundled simulated drive; frames of your own camera fit better")
    uri = calibration or calibration_source()
    with open_sequence(uri) as opened, _progress() as progress:
        prepared = equalised(
            prepared,
            opened,
            wanted=frames,
            use_cache=not no_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
        )
        found = calibrate(
            prepared,
            opened,
            frames,
            name=public_name(uri),
            use_cache=not no_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
            warn=_warn,
        )
        reached = "remembered from an earlier run" if found.from_cache else "run"
        _say(f"calibrated on {len(found.frames.frames)} frames of {found.frames.source} ({reached})")

        ranges = found.observation.ranges(method.value)
        shifts = corrections(
            prepared,
            found,
            ranges,
            opened,
            wanted=frames,
            use_cache=not no_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
        )

    def write(place: Path, given_back: Sequence[str]) -> ModelDirectory:
        graph = build(prepared, found.observation, ranges, given_back=given_back, shifts=shifts)
        return write_directory(prepared, graph, found, place, method=method.value, given_back=given_back)

    search = None
    given_back: tuple[str, ...] = ()
    if budget is not None and validation is not None:
        search = _search(
            prepared,
            found,
            write,
            out=out,
            validation=validation,
            max_drop=budget,
            labelled=max_drop is not None,
            ranges=ranges,
            allow_other_rig=allow_other_rig,
        )
        given_back = search.best.given_back
    written = write(out, given_back)
    tables = _report(
        prepared,
        found,
        written,
        given_back=given_back,
        ranges=ranges,
        shifts=shifts,
        method=method.value,
        validation=validation,
        search=search,
        budget=budget,
        allow_other_rig=allow_other_rig,
    )
    console = report_console()
    for table in tables:
        show_table(console, table, text_columns=2)
    console.print(
        f"wrote {out} in {time.perf_counter() - began_secs:.0f} s; report in {out / 'report.md'}", soft_wrap=True
    )
    if search is not None and not search.holds:
        option = "--max-drop" if max_drop is not None else "--max-disagreement"
        raise GoalMissedError(
            f"{option}: found {search.best.drop_points:+.2f} points lost by the best of {len(search.steps)} models; "
            f"expected at most {budget:g}; the best is kept in {out}: allow more, or train the model longer"
        )


def public_name(uri: str) -> str:
    """A source's URI without the folders above the last: what a model directory may say of where it was made.

    ``kitti-object:/data/kitti/object?split=train`` becomes ``kitti-object:object?split=train``.

    Raises:
        SourceError: ``uri`` is none.
    """
    from runtime.sources.uri import parse_uri

    parsed = parse_uri(uri)
    shown = ",".join(Path(part).name for part in parsed.target.split(","))
    options = {name: Path(value).name for name, value in parsed.options.items() if name != "geometry"}
    kept = "&".join(f"{name}={value}" for name, value in options.items())
    return f"{parsed.scheme}:{shown}" + (f"?{kept}" if kept else "")


def _search(
    prepared: Prepared,
    found: Calibration,
    write: Callable[[Path, Sequence[str]], ModelDirectory],
    *,
    out: Path,
    validation: str,
    max_drop: float,
    labelled: bool,
    ranges: Mapping[str, Range],
    allow_other_rig: bool,
) -> BudgetResult:
    """Runs the budget search in a folder beside the result."""
    import tempfile

    from calib.frames import chosen_frames, frame_feeds
    from edge.evaluation.measure import assess, measure, measurement
    from edge.evaluation.run import run_model
    from quantize.budget import ap_drop_points, disagreement_points, search_budget
    from quantize.sensitivity import own_noise
    from runtime.sources.factory import open_sequence

    with open_sequence(validation) as source:
        _warn_of_overlap(found, source)
        _say(f"measuring the float model on {len(source)} frames")
        reference = assess(run_model(prepared.source.path, source, allow_other_rig=allow_other_rig, warn=_warn))
        before = measurement(reference)
        if labelled:
            ap_drop_points(before, before)  # frames without labels are said before minutes go by
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as folder, _progress() as progress:

            def build(given_back: Sequence[str]) -> Path:
                place = Path(folder) / f"{len(given_back)}-in-float-{len(list(Path(folder).iterdir()))}"
                write(place, given_back)
                return place

            def rank() -> list[str]:
                feeds = list(
                    frame_feeds(
                        chosen_frames(source, RANKING_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig
                    )
                )
                order = own_noise(prepared, found.observation, ranges, feeds, progress=progress)
                return [item.node for item in order]

            return search_budget(
                build,
                lambda place: measure(place, source, reference, allow_other_rig=allow_other_rig),
                drop_points=(lambda after: ap_drop_points(before, after)) if labelled else disagreement_points,
                ranking=rank,
                max_drop=max_drop,
                refinements=REFINEMENTS,
                tell=_say,
            )


def _report(
    prepared: Prepared,
    found: Calibration,
    written: ModelDirectory,
    *,
    given_back: Sequence[str],
    ranges: Mapping[str, Range],
    shifts: Shifts,
    method: str,
    validation: str | None,
    search: BudgetResult | None,
    budget: float | None,
    allow_other_rig: bool,
) -> list[Any]:
    """Measures, writes report.md and report.json into the model directory, and gives the tables to show."""
    from dataclasses import asdict

    from calib.frames import chosen_frames, frame_feeds
    from edge.report.document import report_tables
    from edge.report.evidence import collect_evidence
    from edge.report.quantisation import (
        BudgetRow,
        LayerRow,
        QuantisationRecord,
        cost_table,
        noise_table,
        write_quantisation_report,
    )
    from edge.samples import measuring_source
    from quantize.placement import place
    from quantize.sensitivity import layer_noise
    from quantize.static import build, int8_share
    from runtime.bench import bench_models, profile_directory
    from runtime.contracts.errors import EdgeError
    from runtime.profile import int8_share as share_of_run
    from runtime.sources.factory import open_sequence

    manifest = prepared.source.manifest
    placement = place(prepared.model, prepared.recipe, given_back)
    facts = {
        "recipe": f"{prepared.recipe.name} ({prepared.recipe.note})",
        "target": f"{prepared.recipe.target}, {prepared.recipe.verified}",
        "ranges": f"{method}, {len(found.frames.frames)} frames of {found.frames.source}",
        "calibration pixels SHA-256": found.frames.digest,
        "given back to float": ", ".join(given_back) or "nothing",
    }
    layers: list[Any] = []
    evidence = None
    latency: tuple[dict[str, Any], ...] = ()
    share_run = None
    measurements: list[Measurement] = []
    name = "none"
    try:
        uri = validation or measuring_source()
        if validation is None:
            uri = f"{uri}{'&' if '?' in uri else '?'}limit={REPORT_FRAMES}"
        name = public_name(uri)
        with open_sequence(uri) as source:
            if search is None:
                _warn_of_overlap(found, source)
            pairs = list(chosen_frames(source, TIMED_FRAMES))
            feeds = list(frame_feeds(pairs[:NOISE_FRAMES], manifest, allow_other_rig=allow_other_rig))
            graph = build(prepared, found.observation, ranges, given_back=given_back, shifts=shifts)
            layers = layer_noise(prepared, graph, lambda: feeds)
            paths = [prepared.source.path, written.path]
            runs, measurements = _measure(paths, source, allow_other_rig=allow_other_rig)
            plots = _range_plots(prepared, found, ranges, layers)
            evidence = collect_evidence(written.path, source, runs, plots)
            timed = bench_models(paths, pairs, repeat=TIMED_REPEAT, allow_other_rig=allow_other_rig)
            latency = tuple({**asdict(item), "path": Path(item.path).name} for item in timed)
            share_run = share_of_run(profile_directory(written.path, pairs[:1]))
    except EdgeError as error:
        if validation is not None:
            raise
        _warn(f"the report has no measurements: {error}")
    record = QuantisationRecord(
        facts=facts,
        calibration_frames=tuple((frame.frame_id, frame.pixels) for frame in found.frames.frames),
        layers=tuple(LayerRow(item.node, item.operator, item.snr_db, item.multiply_adds) for item in layers),
        kept_float=tuple(placement.kept_float.items()),
        size_bytes=(prepared.source.model_path.stat().st_size, written.model_path.stat().st_size),
        int8_share=int8_share(prepared, given_back),
        int8_share_run=share_run,
        latency=latency,
        budget=tuple(
            BudgetRow(step.given_back, step.drop_points, step.measurement.latency_ms.get("inference"), step.holds)
            for step in (search.steps if search is not None else ())
        ),
    )
    write_quantisation_report(written.path, record, measurements, source=name, evidence=evidence)
    if search is not None and budget is not None:
        _plot(written.path, record.budget, budget)
    return [*report_tables(measurements), cost_table(record), noise_table(record)]


def _plot(folder: Path, rows: Sequence[Any], budget: float) -> None:
    """The picture of the search, where matplotlib is there to draw it; the table says the same."""
    from edge.report.pareto import BUDGET_PLOT, write_budget_plot

    try:
        write_budget_plot(folder / BUDGET_PLOT, rows, max_drop=budget)
    except ImportError:
        _warn("no picture of the search: matplotlib is missing; pip install '.[report]'")


def _measure(paths: Sequence[Path], source: Any, *, allow_other_rig: bool) -> tuple[Any, list[Measurement]]:
    """Both models on one entered source, the first being the reference; paths are named by their last part."""
    from dataclasses import replace

    from edge.evaluation.measure import assess, measurement
    from edge.evaluation.run import run_model
    from edge.report.terminal import progress_bar

    assessments = []
    for path in paths:
        with progress_bar(f"measuring {path.name}", len(source)) as step:
            run = run_model(path, source, on_frame=step, allow_other_rig=allow_other_rig, warn=_warn)
        assessments.append(assess(run))
    records = [measurement(item, assessments[0] if number else None) for number, item in enumerate(assessments)]
    named = [replace(record, path=path.name) for record, path in zip(records, paths, strict=True)]
    return (assessments[0].run, assessments[1].run), named


def _range_plots(prepared: Prepared, found: Calibration, ranges: Mapping[str, Range], layers: Sequence[Any]) -> Any:
    """What the noisiest layers put out, with the ranges chosen for it."""
    from edge.report.histograms import RangePlot

    plots = []
    for item in sorted(layers, key=lambda layer: layer.snr_db):
        tensor = prepared.placement.outputs[item.node][0]
        tensor = prepared.placement.root_of.get(tensor, tensor)
        seen = found.observation.tensors.get(tensor)
        if seen is None or len(plots) == PLOTTED_LAYERS:
            continue
        low, high = ranges[tensor]
        title = f"{item.node}, {item.snr_db:.1f} dB"
        plots.append(
            RangePlot(title, seen.counts, seen.first_edge, seen.bin_width, low, high, seen.minimum, seen.maximum)
        )
    return plots


def _warn_of_overlap(found: Calibration, source: Any) -> None:
    from calib.frames import overlap

    shared = overlap(found.frames, source)
    if shared:
        _warn(
            f"{len(shared)} of the measured frames calibrated, too (the first is {shared[0]}): "
            "the figures flatter INT8; measure on other frames"
        )


@contextmanager
def _progress() -> Iterator[Callable[[str, int, int], None]]:
    """Bars on standard error, one a stage; silent where that is no terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as progress:
        tasks: dict[str, Any] = {}

        def tell(stage: str, done: int, total: int) -> None:
            if stage not in tasks:
                tasks[stage] = progress.add_task(stage, total=total)
            progress.update(tasks[stage], completed=done, total=total)

        yield tell


def _say(text: str) -> None:
    typer.echo(text, err=True)


def _warn(text: str) -> None:
    typer.echo(f"warning: {text}", err=True)
