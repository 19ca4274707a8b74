"""``edge quantize``: a float model directory to an INT8 one, with a report, and within an accuracy budget if asked."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from edge.cli.calibration_overlap import refuse_overlap
from edge.cli.quantize_checks import PARITY_FRAMES, how_to_repeat, look_at_pixels
from edge.cli.quantize_curve import curve_counts, write_curve_of
from edge.cli.quantize_input import check_out, check_validation, wanted_budget
from edge.cli.quantize_report import report
from edge.cli.quantize_search import search_in_budget
from edge.cli.source_names import public_name
from edge.cli.stages import say, stage_progress, warn

if TYPE_CHECKING:
    from quantize.adjustments import Way
    from runtime.contracts.manifest import ModelDirectory

DEFAULT_FRAMES = 100


class ChoiceMethod(StrEnum):
    """Which frames of the source calibrate."""

    COVERAGE = "coverage"
    FARTHEST = "farthest"
    SPREAD = "spread"


class Method(StrEnum):
    """How ranges follow from the values that were seen; ``search`` looks at what they do to the outputs."""

    SEARCH = "search"
    MINMAX = "minmax"
    PERCENTILE = "percentile"
    MSE = "mse"
    ENTROPY = "entropy"


def quantize_command(
    context: typer.Context,
    model: Annotated[Path, typer.Argument(help="Float model directory of `edge export`.")],
    out: Annotated[Path, typer.Option(help="Model directory to write; an older one there is replaced.")],
    calibration: Annotated[
        str | None, typer.Option(help="Frames that show the ranges; default: the bundled calibration drive.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many of them, chosen for variety.")] = DEFAULT_FRAMES,
    choice: Annotated[
        ChoiceMethod, typer.Option(help="How frames are chosen: by what they show, or spread evenly in time.")
    ] = ChoiceMethod.COVERAGE,
    target: Annotated[
        str | None,
        typer.Option(help="x86-vnni, x86-avx2, arm64, generic, openvino or tensorrt; default: this machine."),
    ] = None,
    method: Annotated[Method, typer.Option(help="Range method.")] = Method.SEARCH,
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
    max_shift: Annotated[
        float | None,
        typer.Option(help="Or centimetres by which matched boxes within 30 m may shift in the mean; needs no labels."),
    ] = None,
    curve: Annotated[
        str | None, typer.Option(help="Also measure models of so many calibration frames, for example 1,4,16,64.")
    ] = None,
    allow_overlap: Annotated[
        bool, typer.Option("--allow-overlap", help="Measure on calibration frames, too, with a warning.")
    ] = False,
    no_cache: Annotated[bool, typer.Option("--no-cache", help="Neither use nor keep earlier calibrations.")] = False,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
) -> None:
    """Quantise a model; exit 1 where the accuracy budget cannot be kept."""
    import time
    from functools import partial

    from edge.report.terminal import report_console, show_table
    from edge.samples import calibration_source
    from quantize.adjustments import adjusted_ways, build_adjusted
    from quantize.calibration import calibrate, choose_frames, equalised
    from quantize.prepare import prepare_model
    from quantize.range_search import settled_ranges
    from quantize.recipe import detect_target, recipe_for_target
    from quantize.write import write_directory
    from runtime.contracts.errors import EdgeError, GoalMissedError
    from runtime.contracts.manifest import open_model_directory
    from runtime.sources.factory import open_sequence

    counts = curve_counts(curve)
    budget = wanted_budget(
        {"--max-drop": max_drop, "--max-disagreement": max_disagreement, "--max-shift": max_shift}, validation
    )
    began_secs = time.perf_counter()
    directory = open_model_directory(model)
    check_out(out, model)
    if validation is not None:
        check_validation(validation, directory.manifest.classes, labelled=budget is not None and budget.labelled)
    recipe = recipe_for_target(target or detect_target())
    prepared = prepare_model(directory, recipe)
    if prepared.pixel_note is not None:
        say(f"pixels are normalised in float: {prepared.pixel_note}")
    if calibration is None:
        say("no --calibration: ranges come from the bundled simulated drive; frames of your own camera fit better")
    uri = calibration or calibration_source()
    with open_sequence(uri) as opened, stage_progress() as progress:
        use_cache = not no_cache
        chosen = choose_frames(
            prepared,
            opened,
            frames,
            name=public_name(uri),
            method=choice.value,
            use_cache=use_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
            warn=warn,
        )
        if validation is not None:
            refuse_overlap(chosen.chosen, validation, allow=allow_overlap, use_cache=use_cache)
        prepared = equalised(prepared, chosen, use_cache=use_cache, allow_other_rig=allow_other_rig, progress=progress)
        found = calibrate(prepared, chosen, use_cache=use_cache, allow_other_rig=allow_other_rig, progress=progress)
        reached = "remembered from an earlier run" if found.from_cache else "run"
        say(f"calibrated on {len(found.frames.frames)} frames of {found.frames.source} ({reached})")
        coverage = found.frames.coverage
        if coverage is not None:
            say(
                f"coverage {coverage.score:.2f} of {coverage.pool} frames looked at "
                f"(as many evenly spread frames: {coverage.even_score:.2f})"
            )

        settled = settled_ranges(
            prepared,
            found,
            chosen,
            method.value,
            use_cache=use_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
        )
        ways = adjusted_ways(  # what costs nothing at run time is tried before any layer goes back to float
            prepared,
            found,
            settled.ranges,
            chosen,
            every=budget is not None,
            use_cache=use_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
        )
        looked_at = list(chosen.frames(PARITY_FRAMES))

    def write(way: Way, place: Path, given_back: Sequence[str]) -> ModelDirectory:
        graph = build_adjusted(way.prepared, found, settled.ranges, way.adjustments, given_back=given_back)
        return write_directory(way.prepared, graph, found, place, method=settled.name, given_back=given_back)

    search = None
    given_back: tuple[str, ...] = ()
    way = next(iter(ways.values()))
    if budget is not None and validation is not None:
        search = search_in_budget(
            prepared,
            found,
            {name: partial(write, some) for name, some in ways.items()},
            out=out,
            validation=validation,
            budget=budget,
            ranges=settled.ranges,
            allow_other_rig=allow_other_rig,
        )
        given_back, way = search.best.given_back, ways[search.best.way]
    written = write(way, out, given_back)
    parity = look_at_pixels(prepared, written, looked_at)
    tables = report(
        way,
        found,
        written,
        given_back=given_back,
        settled=settled,
        validation=validation,
        search=search,
        budget=budget,
        parity=parity,
        repeat=how_to_repeat(context, way.prepared, found, written, given_back=given_back),
        use_cache=use_cache,
        allow_other_rig=allow_other_rig,
    )
    if counts:
        try:
            write_curve_of(
                prepared,
                out,
                counts,
                calibration=uri,
                choice=choice.value,
                validation=validation,
                settled=settled,
                use_cache=use_cache,
                allow_other_rig=allow_other_rig,
            )
        except EdgeError as error:
            if validation is not None:
                raise
            warn(f"no curve: {error}")
    console = report_console()
    for table in tables:
        show_table(console, table, text_columns=2)
    console.print(
        f"wrote {out} in {time.perf_counter() - began_secs:.0f} s; report in {out / 'report.md'}", soft_wrap=True
    )
    if not parity.passed:
        raise GoalMissedError(
            f"parity: found {len(parity.failures)} of {len(parity.checks)} checks of the pixels failed; expected none; "
            f"the figures of {out} say little before this is mended: see the remedies in {out / 'report.md'}"
        )
    if budget is not None and search is not None and not search.holds:
        raise GoalMissedError(
            f"{budget.option}: found {search.best.lost:+.2f} {budget.unit} by the best of {len(search.steps)} models; "
            f"expected at most {budget.limit:g}; the best is kept in {out}: allow more, or train the model longer"
        )
