"""``edge train``: fit a preset to labelled stereo frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Optional

import typer


def train_command(
    dataset: Annotated[list[str], typer.Option(help="Labelled stereo source URI; give it again for more.")],
    out: Annotated[Path, typer.Option(help="Run directory: checkpoint, log, plot, weights.")],
    preset: Annotated[str, typer.Option(help="paper or compact.")] = "compact",
    repeat: Annotated[
        Optional[list[int]],  # noqa: UP045 - typer reads this form
        typer.Option(help="How often an epoch shows each --dataset, in their order; 1 where not given."),
    ] = None,
    priors: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Anchor priors from `edge priors`; computed from the datasets where not given."),
    ] = None,
    backbone: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="ImageNet weights of the backbone, torchvision names."),
    ] = None,
    start: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Weights or checkpoint to start from, with a fresh optimiser."),
    ] = None,
    steps: Annotated[int, typer.Option(help="Optimisation steps of the whole run.")] = 10000,
    cooldown: Annotated[int, typer.Option(help="Last steps, over which the learning rate falls (hold).")] = 1000,
    schedule: Annotated[str, typer.Option(help="hold or cosine.")] = "hold",
    batch: Annotated[Optional[int], typer.Option(help="Pairs a step; the preset's where not given.")] = None,  # noqa: UP045
    learning_rate: Annotated[Optional[float], typer.Option(help="Peak; the preset's where not given.")] = None,  # noqa: UP045
    workers: Annotated[int, typer.Option(help="Processes that read frames.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    precision: Annotated[
        str, typer.Option(help="auto, bf16 or float32; auto is bf16 where the hardware has it.")
    ] = "auto",
    seed: Annotated[int, typer.Option(help="Seed of weights, order and augmentation.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
) -> None:
    """Train; writes weights.safetensors, priors.npz, run.json, log.csv, a plot, and checkpoints that resume."""
    import shutil

    import torch
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    from edge.detector.network import StereoDetector
    from edge.detector.presets import preset as find_preset
    from edge.detector.weights import PRIORS_KEY, load_backbone, load_weights, priors_digest, save_weights
    from edge.training.labelled_views import labelled_views
    from edge.training.log_plot import plot_log
    from edge.training.loop import train
    from edge.training.precision import wants_mixed_precision
    from edge.training.priors import anchor_statistics
    from edge.training.run_record import RunSettings, check_same_run, write_settings
    from edge.training.samples import SampleMaker
    from edge.training.stream import MixedFrames
    from runtime.contracts.errors import CheckpointError, EdgeError, OutputError
    from runtime.contracts.manifest import file_sha256, read_priors, write_priors
    from runtime.sources.factory import open_sequence

    chosen = find_preset(preset)
    weights = list(repeat or []) + [1] * (len(dataset) - len(repeat or []))
    if len(weights) != len(dataset) or min(weights) < 1:
        raise EdgeError(
            f"--repeat names {len(repeat or [])} counts for {len(dataset)} datasets, expected at most one each, from 1"
        )
    if schedule not in ("hold", "cosine"):
        raise EdgeError(f"--schedule is {schedule!r}, expected hold or cosine; choose one")
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise EdgeError("--device cuda finds no GPU, expected one with a CUDA build of torch; use --device cpu")
    if out.exists() and any(out.iterdir()) and not resume:
        raise OutputError(f"{out} is not empty, expected a new run directory; choose another --out or add --resume")
    out.mkdir(parents=True, exist_ok=True)
    console = Console(stderr=True)

    torch.manual_seed(seed)
    sources = [open_sequence(uri) for uri in dataset]
    priors_file = out / "priors.npz"
    if priors is not None and priors_file.exists() and file_sha256(priors) != file_sha256(priors_file):
        raise CheckpointError(f"{priors} are not the priors of the run in {out}, expected the same; leave --priors out")
    if not priors_file.exists():
        if priors is not None:
            shutil.copyfile(priors, priors_file)
        else:
            views = (view for source in sources for view in labelled_views(source, chosen))
            write_priors(
                priors_file,
                chosen.classes,
                anchor_statistics(views, chosen.classes, chosen.anchors, input_size_hw=chosen.input_size_hw),
            )
    tables = read_priors(priors_file, chosen.classes, chosen.anchors)
    detector = StereoDetector(chosen)
    if backbone is not None:
        load_backbone(detector, backbone)
    if start is not None:
        load_weights(detector, start)
    frames = MixedFrames(sources, weights, maker=SampleMaker(chosen, tables), seed=seed)
    kind: Literal["cosine", "hold"] = "hold" if schedule == "hold" else "cosine"
    settings = RunSettings(
        steps=steps,
        batch_size=batch or chosen.training.batch_size,
        learning_rate=learning_rate or chosen.training.learning_rate,
        final_learning_rate=chosen.training.final_learning_rate,
        schedule=kind,
        cooldown_steps=min(cooldown, steps) if kind == "hold" else 0,
        workers=workers,
        seed=seed,
        device=device,
        mixed_precision=wants_mixed_precision(precision, device),
    )
    if resume:
        check_same_run(out, chosen, settings)
    write_settings(out, chosen, settings, dict(zip(dataset, weights, strict=True)))
    console.print(f"{frames.epoch_length} samples an epoch, {settings.batch_size} a step, {steps} steps")
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("training", total=steps)

        def show(step: int, losses: dict[str, float]) -> None:
            total = losses["class_loss"] + losses["box_loss"]
            progress.update(task, completed=step, description=f"training, loss {total:.3f}")

        average = train(detector, chosen, frames, settings=settings, run_dir=out, resume=resume, on_step=show)
    if not all(torch.isfinite(value).all() for value in average.state.values() if value.is_floating_point()):
        raise CheckpointError(f"the run in {out} ended with weights that are not finite; lower --learning-rate")
    weights_file = out / "weights.safetensors"
    metadata = {
        "preset": chosen.name,
        "steps": str(steps),
        "seed": str(seed),
        PRIORS_KEY: priors_digest(tables, chosen.classes),
    }
    save_weights(weights_file, {name: value.cpu() for name, value in average.state.items()}, metadata=metadata)
    plot_log(out / "log.csv", out / "log.png")
    console.print(f"wrote {weights_file}")
