"""``edge simulate``: labelled stereo frames or drives of a procedural road world."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def simulate_command(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to make.")],
    frames: Annotated[int, typer.Option(help="Number of single frames.")] = 100,
    sequence: Annotated[bool, typer.Option("--sequence", help="One 10 Hz drive in KITTI's tracking layout.")] = False,
    seconds: Annotated[float, typer.Option(help="Length of the drive.")] = 10.0,
    rig: Annotated[str, typer.Option(help="kitti, oak-d, or a geometry file (ours or depthai's JSON).")] = "kitti",
    seed: Annotated[int, typer.Option(help="Frame i is made from seed + i.")] = 0,
    format: Annotated[str, typer.Option(help="Image files: jpg, png or webp.")] = "jpg",
    quality: Annotated[int, typer.Option(help="Quality of jpg and webp.")] = 92,
    people: Annotated[float, typer.Option(help="Frames with pedestrians or cyclists so many times as often.")] = 1.0,
    near: Annotated[float, typer.Option(help="Objects within 10 m, whole or cut off, so many times as often.")] = 1.0,
    workers: Annotated[int, typer.Option(help="Processes that render.")] = 2,
) -> None:
    """Write simulated stereo frames with exact KITTI labels.

    Single frames go to KITTI's object layout and follow the statistics of KITTI's training labels
    unless --people or --near ask for more of what is rare; ImageSets/all, train and val each name every frame of the
    set. The rig is written to OUT/rig.json.
    """
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from edge.simulation.drafts import Mix
    from edge.simulation.simulate import simulate

    console = Console(stderr=True)
    columns = (TextColumn("simulate"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=console)
    task = bar.add_task("simulate", total=None)

    def report(done: int, total: int) -> None:
        bar.start()  # only now: wrong input gets its one line and no bar
        bar.update(task, completed=done, total=total)

    try:
        count = simulate(
            out, frames=frames, sequence=sequence, seconds=seconds, rig=rig, seed=seed, image_format=format,
            quality=quality, mix=Mix(people=people, near=near), workers=workers, progress=report,
        )  # fmt: skip
    finally:
        bar.stop()
    more = "" if sequence or count <= frames else f", more than --frames {frames}: those that were there stay listed"
    console.print(f"{count} labelled pairs in {out}{more}", highlight=False, soft_wrap=True)
