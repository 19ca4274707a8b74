"""The report of ``edge quantize``: measures the written model beside the float one and says what INT8 cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.cli.calibration_overlap import warn_of_overlap
from edge.cli.source_names import public_name
from edge.cli.stages import warn

if TYPE_CHECKING:
    from calib.methods import Range
    from edge.evaluation.run import ModelRun
    from edge.report.parity import ParityRecord
    from edge.report.repeat import RepeatRecord
    from quantize.adjustments import Way
    from quantize.budget import BudgetResult
    from quantize.budget_kinds import Budget
    from quantize.calibration import Calibration
    from quantize.prepare import Prepared
    from quantize.range_search import RangeSearch
    from runtime.contracts.manifest import ModelDirectory
    from runtime.contracts.measurement import Measurement
    from runtime.peak_memory import PeakMemory
    from runtime.turns import ModelBench

NOISE_FRAMES = 2
PLOTTED_LAYERS = 6
REPORT_FRAMES = 12
"""Frames of the bundled drive that the report measures; a --validation source is measured whole."""


def report(
    way: Way,
    found: Calibration,
    written: ModelDirectory,
    *,
    given_back: Sequence[str],
    settled: RangeSearch,
    validation: str | None,
    search: BudgetResult | None,
    budget: Budget | None,
    parity: ParityRecord,
    repeat: RepeatRecord,
    use_cache: bool,
    allow_other_rig: bool,
) -> list[Any]:
    """Measures, writes report.md and report.json into the model directory, and gives the tables to show."""
    from concurrent.futures import ThreadPoolExecutor
    from dataclasses import asdict

    from calib.frames import frame_feeds, spread_frames
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
    from quantize.adjustments import build_adjusted
    from quantize.placement import place
    from quantize.prepare import int8_share
    from quantize.sensitivity import layer_noise
    from runtime.bench import profile_directory
    from runtime.contracts.errors import EdgeError
    from runtime.peak_memory import peak_memory
    from runtime.profile import int8_share as share_of_run
    from runtime.sources.factory import open_sequence

    prepared, ranges = way.prepared, settled.ranges
    manifest = prepared.source.manifest
    placement = place(prepared.model, prepared.recipe, given_back)
    facts = {
        "recipe": f"{prepared.recipe.name} ({prepared.recipe.note})",
        "target": f"{prepared.recipe.target}, {prepared.recipe.verified}",
        "ranges": f"{settled.name}, {len(found.frames.frames)} frames of {found.frames.source}",
        **_search_facts(settled),
        "adjustments": prepared.recipe.adjustments,
        **_coverage_facts(found),
        "calibration pixels SHA-256": found.frames.digest,
        "given back to float": ", ".join(given_back) or "nothing",
    }
    layers: list[Any] = []
    evidence = None
    latency: tuple[dict[str, Any], ...] = ()
    memory: tuple[PeakMemory | None, ...] = ()
    share_run = None
    measurements: list[Measurement] = []
    name = "none"
    try:
        uri = validation or f"{measuring_source()}?limit={REPORT_FRAMES}"
        name = public_name(uri)
        with open_sequence(uri) as source:
            if validation is None:
                warn_of_overlap(found.frames, source, name=name, use_cache=use_cache)
            pairs = list(spread_frames(source, NOISE_FRAMES))
            feeds = list(frame_feeds(pairs, manifest, allow_other_rig=allow_other_rig))
            graph = build_adjusted(prepared, found, ranges, way.adjustments, given_back=given_back)
            layers = layer_noise(prepared, graph, lambda: feeds)
            paths = [prepared.source.path, written.path]
            runs, measurements, timed = _measure(paths, source, allow_other_rig=allow_other_rig)
            plots = _range_plots(prepared, found, ranges, layers)
            latency = tuple({**asdict(item), "path": Path(item.path).name} for item in timed)
            with ThreadPoolExecutor() as beside:  # none of these measures time
                peaks = [beside.submit(peak_memory, path, pairs[0]) for path in paths]
                profile = beside.submit(profile_directory, written.path, pairs[:1])
                evidence = collect_evidence(written.path, source, runs, plots)
                memory = tuple(peak.result() for peak in peaks)
                share_run = share_of_run(profile.result())
    except EdgeError as error:
        if validation is not None:
            raise
        facts["no measurements"] = str(error)
        warn(f"the report has no measurements: {error}")
    record = QuantisationRecord(
        facts=facts,
        calibration_frames=tuple((frame.frame_id, frame.pixels) for frame in found.frames.frames),
        layers=tuple(LayerRow(item.node, item.operator, item.snr_db, item.multiply_adds) for item in layers),
        kept_float=tuple(placement.kept_float.items()),
        size_bytes=(prepared.source.model_path.stat().st_size, written.model_path.stat().st_size),
        int8_share=int8_share(prepared, given_back),
        int8_share_run=share_run,
        latency=latency,
        memory=memory,
        budget=tuple(
            BudgetRow(step.given_back, step.lost, step.measurement.latency_ms.get("inference"), step.holds, step.way)
            for step in (search.steps if search is not None else ())
        ),
        budget_unit="" if budget is None else budget.unit,
        parity=parity,
        repeat=repeat,
    )
    write_quantisation_report(written.path, record, measurements, source=name, evidence=evidence)
    if search is not None and budget is not None:
        _budget_plot(written.path, record.budget, budget)
    return [*report_tables(measurements), cost_table(record), noise_table(record)]


def _search_facts(settled: RangeSearch) -> dict[str, str]:
    if settled.error is None or settled.first_error is None:
        return {}
    return {
        "error at the outputs": f"{settled.error:.3g} of the signal's power, weighted; {settled.first_error:.3g} with "
        f"{settled.method} ranges, {settled.trials} trials"
    }


def _coverage_facts(found: Calibration) -> dict[str, str]:
    coverage = found.frames.coverage
    if coverage is None:
        return {"frames chosen by": found.frames.method}
    return {
        "frames chosen by": f"{found.frames.method}, of {coverage.pool} looked at ({', '.join(coverage.looked_at)})",
        "coverage of the calibration frames": f"{coverage.score:.2f} (evenly spread ones: {coverage.even_score:.2f})",
    }


def _budget_plot(folder: Path, rows: Sequence[Any], budget: Budget) -> None:
    """The picture of the search, where matplotlib is there to draw it; the table says the same."""
    from edge.report.pareto import write_budget_plot
    from runtime.model_folder import BUDGET_PLOT

    try:
        write_budget_plot(folder / BUDGET_PLOT, rows, limit=budget.limit, unit=budget.unit)
    except ImportError:
        warn("no picture of the search: matplotlib is missing; pip install '.[report]'")


def _measure(
    paths: Sequence[Path], source: Any, *, allow_other_rig: bool
) -> tuple[tuple[ModelRun, ModelRun], list[Measurement], list[ModelBench]]:
    """Both models on one entered source, the first being the reference; records name them by their paths' last part."""
    from dataclasses import replace

    from edge.evaluation.measure import assess, measurement
    from edge.evaluation.side_by_side import run_side_by_side
    from edge.report.terminal import progress_bar

    with progress_bar("measuring both models", len(source)) as step:
        (first, second), timed = run_side_by_side(
            paths, source, on_frame=step, allow_other_rig=allow_other_rig, warn=warn
        )
    reference = assess(first)
    records = [measurement(reference), measurement(assess(second), reference)]
    named = [replace(record, path=path.name) for record, path in zip(records, paths, strict=True)]
    return (first, second), named, timed


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
