"""``edge bench``: models against each other, frame by frame in turns."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from edge.report.rows import Table
    from runtime.profile import NodeTime
    from runtime.turns import ModelBench

DEFAULT_FRAMES, DEFAULT_REPEAT = 10, 3
OPERATORS_SHOWN = 8


def bench_command(
    models: Annotated[list[Path], typer.Argument(help="Model directories; ratios refer to the first.")],
    source: Annotated[str | None, typer.Option(help="Frames to look at; default: the bundled drive.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many of them, kept in memory.")] = DEFAULT_FRAMES,
    repeat: Annotated[int, typer.Option(min=1, help="How often each is looked at.")] = DEFAULT_REPEAT,
    threads: Annotated[int | None, typer.Option(min=1, help="Of one operator; default: all cores.")] = None,
    profile: Annotated[bool, typer.Option("--profile", help="Also show the time of each operator.")] = False,
    native: Annotated[bool, typer.Option(help="Use the native library: correlations, suppression, depths.")] = True,
    json: Annotated[Path | None, typer.Option(help="Write the figures to this file.")] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace that file if it is there.")] = False,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
) -> None:
    """Latency by stage, start-up and memory; models take turns, so a busy machine hits all alike."""
    from itertools import islice

    from edge.report.files import write_json
    from edge.report.terminal import progress_bar, report_console, show_table
    from edge.samples import measuring_source
    from runtime.bench import bench_models, profile_directory
    from runtime.contracts.manifest import open_model_directory
    from runtime.sinks.places import claim_file
    from runtime.sources.factory import open_source

    for path in models:
        open_model_directory(path)  # a wrong one is said before the first has run for minutes
    if json is not None:
        claim_file(json, overwrite=overwrite)
    chosen = source or measuring_source()
    with open_source(chosen) as opened:
        pairs = list(islice(iter(opened), frames))
    with progress_bar("timing", len(pairs) * repeat) as step:
        records = bench_models(
            models,
            pairs,
            repeat=repeat,
            threads=threads,
            use_native=native,
            allow_other_rig=allow_other_rig,
            progress=lambda done, total: step(),
        )
    profiles = (
        [profile_directory(path, pairs[:DEFAULT_REPEAT], threads=threads, use_native=native) for path in models]
        if profile
        else []
    )
    if json is not None:
        write_json(json, _record(records, profiles, source=chosen, frames=len(pairs), threads=threads))
    console = report_console()
    show_table(console, latency_table(records), text_columns=2)
    for item, nodes in zip(records, profiles, strict=False):
        show_table(console, operator_table(item.path, nodes), text_columns=1)


def latency_table(records: list[ModelBench]) -> Table:
    """Medians with the middle four fifths, one row a model."""
    from edge.report.document import model_names
    from edge.report.rows import Table
    from runtime.contracts.measurement import Measurement
    from runtime.turns import TOTAL

    names = model_names([Measurement(path=item.path, ap={}, frames=0) for item in records])
    stages = [stage for stage in records[0].stages if stage != TOTAL]
    rows = []
    for name, item in zip(names, records, strict=True):
        total = item.stages[TOTAL]
        rows.append(
            (
                name,
                item.recipe,
                *(f"{item.stages[stage].median:.1f}" for stage in stages),
                f"{total.median:.1f} [{total.low:.1f}, {total.high:.1f}]",
                f"{item.ratio:.2f}",
                f"{item.start_up_ms:.0f}",
                "-" if item.memory_mib is None else f"{item.memory_mib:.0f}",
            )
        )
    correlation = {"native library" if item.native else "function body" for item in records}
    return Table(
        "Latency in ms a frame, medians",
        ("model", "recipe", *stages, "total [p10, p90]", "ratio", "start-up", "MiB"),
        tuple(rows),
        note=f"{records[0].runs} runs a model, in turns; correlation: {', '.join(sorted(correlation))}.",
    )


def operator_table(path: str, nodes: list[NodeTime]) -> Table:
    """The slowest operators of a model."""
    from edge.report.rows import Table
    from runtime.profile import by_operator, int8_share

    sums = by_operator(nodes)
    shown = sums[:OPERATORS_SHOWN]
    rows = [(item.operator, str(item.nodes), f"{item.ms:.2f}", f"{item.multiply_adds / 1e9:.2f}") for item in shown]
    rest = sums[OPERATORS_SHOWN:]
    if rest:
        count, ms = sum(item.nodes for item in rest), sum(item.ms for item in rest)
        giga = sum(item.multiply_adds for item in rest) / 1e9
        rows.append(("all others", str(count), f"{ms:.2f}", f"{giga:.2f}"))
    return Table(
        f"{Path(path).name}: operators as they ran",
        ("operator", "nodes", "ms", "G multiply-adds"),
        tuple(rows),
        note=f"{100 * int8_share(nodes):.1f} % of the multiply-adds ran in 8 bits.",
    )


def _record(
    records: list[ModelBench], profiles: list[list[NodeTime]], *, source: str, frames: int, threads: int | None
) -> dict[str, Any]:
    import platform
    from dataclasses import asdict

    from runtime.profile import by_operator, int8_share

    models = [asdict(item) for item in records]
    for item, nodes in zip(models, profiles, strict=False):
        item["operators"] = [asdict(operator) for operator in by_operator(nodes)]
        item["int8_share_of_multiply_adds"] = int8_share(nodes)
    return {
        "schema_version": 1,
        "source": source,
        "frames": frames,
        "threads": threads,
        "machine": platform.machine(),
        "models": models,
    }
