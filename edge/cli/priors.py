"""``edge priors``: anchor statistics of labelled frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def priors_command(
    dataset: Annotated[list[str], typer.Option(help="Labelled source URI; give it again for more.")],
    out: Annotated[Path, typer.Option(help="File to write, .npz.")],
    preset: Annotated[str, typer.Option(help="Preset whose anchors and classes count.")] = "compact",
    overwrite: Annotated[bool, typer.Option(help="Replace the file if it is there.")] = False,
) -> None:
    """Compute depth, angle and size statistics of each anchor shape and class."""
    from rich.console import Console
    from rich.progress import track

    from edge.detector.presets import preset as find_preset
    from edge.training.labelled_views import labelled_views
    from edge.training.priors import anchor_statistics
    from runtime.contracts.manifest import write_priors
    from runtime.sinks.places import claim_file
    from runtime.sources.factory import open_sequence

    chosen = find_preset(preset)
    claim_file(out, overwrite=overwrite)
    console = Console(stderr=True)
    frames = []
    for uri in dataset:
        with open_sequence(uri) as source:
            frames += list(track(labelled_views(source, chosen), f"reading {uri}", total=len(source), console=console))
    tables = anchor_statistics(
        track(frames, "overlapping anchors", console=console),
        chosen.classes,
        chosen.anchors,
        input_size_hw=chosen.input_size_hw,
    )
    beside = out.with_name(out.name + ".part")
    write_priors(beside, chosen.classes, tables)
    beside.replace(out)
    for index, name in enumerate(chosen.classes):
        usable = int((tables.mean[index, ..., 0] > 0).sum())
        console.print(f"{name}: {usable} of {chosen.anchors.per_cell} anchor shapes have a prior")
    console.print(f"wrote {out}")
