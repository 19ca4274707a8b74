"""``edge train``: fit a preset to labelled stereo frames."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Optional

import typer

from edge.cli.train_config import read_config, stages_to_run


def train_command(
    context: typer.Context,
    dataset: Annotated[
        list[str], typer.Option(help="Labelled source URI, of pairs but for mono; give it again for more.")
    ],
    out: Annotated[Path, typer.Option(help="Run directory: checkpoint, log, plot, weights.")],
    preset: Annotated[str, typer.Option(help="compact, paper or mono.")] = "compact",
    method: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="paper or official: that set of losses, targets and epochs; the preset's own if not given."),
    ] = None,
    ablate: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="Row of the paper's ablation table, see docs/paper.md; give it again for more."),
    ] = None,
    repeat: Annotated[
        Optional[list[int]],  # noqa: UP045 - typer reads this form
        typer.Option(help="How often an epoch shows each --dataset, in their order; 1 where not given."),
    ] = None,
    priors: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            help="Anchor priors from `edge priors`; else KITTI's for paper and mono on KITTI's rig, or the datasets'."
        ),
    ] = None,
    backbone: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="ImageNet weights of the backbone, torchvision names."),
    ] = None,
    start: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Weights or checkpoint to start from, with a fresh optimiser."),
    ] = None,
    steps: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=1,
            help="Steps of the whole run; else what it had with --resume, the preset's epochs, or 10000.",
        ),
    ] = None,
    epochs: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Length of the run in epochs, instead of --steps."),
    ] = None,
    cooldown: Annotated[int, typer.Option(min=0, help="Last steps, over which the learning rate falls (hold).")] = 1000,
    warmup: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=0, help="First steps, over which it rises; 100 with hold, else 0, if not given."),
    ] = None,
    schedule: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="hold, cosine (by epoch) or cosine-step; the preset's where not given."),
    ] = None,
    batch: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Pairs a step, of all processes together; the preset's where not given."),
    ] = None,
    learning_rate: Annotated[Optional[float], typer.Option(help="Peak; the preset's where not given.")] = None,  # noqa: UP045
    workers: Annotated[int, typer.Option(min=0, help="Processes that read frames.")] = 1,
    device: Annotated[str, typer.Option(help="cpu or cuda.")] = "cpu",
    precision: Annotated[
        str, typer.Option(help="auto, bf16 or float32; auto is bf16 where the hardware has it.")
    ] = "auto",
    average_decay: Annotated[
        float,
        typer.Option(min=0, max=1, help="Of the average of the weights, which is what is saved; 0 saves the last."),
    ] = 0.99,
    freeze_norms: Annotated[
        bool, typer.Option("--freeze-norms", help="Keep the statistics of all batch norms, for small batches.")
    ] = False,
    freeze_backbone: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(
            min=0, max=4, help="Parts that keep their weights: stem, then stages; the preset's where not given."
        ),
    ] = None,
    paste: Annotated[
        float,
        typer.Option(min=0, max=1, help="Share of frames that get objects of other frames; stereo presets."),
    ] = 0.0,
    zoom: Annotated[
        float, typer.Option(min=0, max=1, help="Share of frames that are zoomed, depths with them; preset compact.")
    ] = 0.0,
    faults: Annotated[
        float,
        typer.Option(min=0, max=1, help="Share of pairs with camera faults: light, blur, noise, JPEG, rectification."),
    ] = 0.0,
    unlabelled: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="Source URI of pairs that teach disparity alone; give it again for more."),
    ] = None,
    quantize_aware: Annotated[
        bool, typer.Option("--quantize-aware", help="Learn to stand 8-bit rounding; for a run's last steps.")
    ] = False,
    weight_bits: Annotated[
        int,
        typer.Option(min=7, max=8, help="Of that rounding: 7 for INT8 targets with 7-bit weights (generic, x86-avx2)."),
    ] = 8,
    validation: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Labelled stereo source URI: AP while training, and the best weights kept."),
    ] = None,
    validate_every: Annotated[
        int, typer.Option(min=0, help="Steps between validations; 0 validates after each epoch.")
    ] = 0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of weights, order and augmentation.")] = 0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the run's checkpoint.")] = False,
    before_cooldown: Annotated[
        bool, typer.Option("--before-cooldown", help="With --resume: go on from before the run's cooldown.")
    ] = False,
    config: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            is_eager=True,
            callback=read_config,
            help="TOML file of options and of stages (tables named stages); options given here go first.",
        ),
    ] = None,
) -> None:
    """Train; writes weights.safetensors (averaged weights), priors.npz, run.json, logs, and checkpoints that resume.

    With --validation also best.safetensors. Started by torchrun, several processes or machines train as one.
    """
    stages = stages_to_run(context, out, resume=resume)
    for stage in stages:
        stage.command.invoke(stage)
    if stages:
        return
    import torch

    from edge.cli.train_progress import TrainProgress
    from edge.detector.ablations import ablated
    from edge.detector.build import build_detector
    from edge.detector.checkpoint_file import read_checkpoint
    from edge.detector.presets import preset as find_preset
    from edge.detector.presets import with_frozen_backbone
    from edge.detector.weights import PRIORS_KEY, load_backbone, load_weights, priors_digest, save_weights
    from edge.training.checkpoint import back_to_hold
    from edge.training.distributed import process_group, ranks_of_environment, wait_for_all
    from edge.training.frame_changes import frame_changes
    from edge.training.loop import train
    from edge.training.methods import with_method
    from edge.training.origin import origin_card, origin_record, overlap_notes, priors_origin, start_notes
    from edge.training.precision import wants_mixed_precision
    from edge.training.rig import rig_metadata, with_rig_of_data
    from edge.training.run_record import RunSettings, check_same_run, length_before, write_settings
    from edge.training.samples import SampleMaker
    from edge.training.schedule import schedule_kind
    from edge.training.start import check_device, check_unlabelled, keep_priors, open_run, run_priors, run_steps
    from edge.training.stream import MixedFrames
    from edge.training.validation import Validation
    from edge.training.widen import widened
    from runtime.contracts.errors import CheckpointError, EdgeError
    from runtime.model_folder import CARD_FILE
    from runtime.sources.factory import open_sequence

    chosen = find_preset(preset) if method is None else with_method(find_preset(preset), method)
    chosen = ablated(chosen, ablate or [])
    if freeze_backbone is not None:
        chosen = with_frozen_backbone(chosen, freeze_backbone)
    weights = list(repeat or []) + [1] * (len(dataset) - len(repeat or []))
    if len(weights) != len(dataset) or min(weights) < 1:
        raise EdgeError(
            f"--repeat names {len(repeat or [])} counts for {len(dataset)} datasets, expected at most one each, from 1"
        )
    kind = schedule_kind(schedule or chosen.training.schedule)
    batch_size = batch or chosen.training.batch_size
    if learning_rate is not None and not 0.0 < learning_rate < math.inf:
        raise EdgeError(f"--learning-rate is {learning_rate:g}, expected more than 0; leave it out for the preset's")
    check_device(device)
    check_unlabelled(chosen, unlabelled or [])
    ranks = ranks_of_environment()
    ranks.share_of(batch_size)
    sources = [open_sequence(uri) for uri in dataset]
    chosen = with_rig_of_data(chosen, sources)
    without_labels = [open_sequence(uri) for uri in unlabelled or []]
    changes = frame_changes(chosen, sources, method=method, paste=paste, zoom=zoom, faults=faults)
    measured = open_sequence(validation) if validation is not None else None
    first_step, origin = 0, ""
    if ranks.writes:  # before the others join: what is wrong is said once
        first_step = open_run(out, resume=resume, before_cooldown=before_cooldown)
        if resume:
            check_same_run(out, chosen, seed=seed, batch_size=batch_size)
        origin = priors_origin(out, chosen, priors)
        run_priors(out, chosen, sources, given=priors)
    with process_group(device) as (ranks, own_device):
        wait_for_all(ranks)
        if not ranks.writes:
            first_step = open_run(out, resume=True, before_cooldown=before_cooldown) if resume else 0
        tables = run_priors(out, chosen, sources, given=None)
        torch.manual_seed(seed)
        detector, grown = build_detector(chosen), ()
        if backbone is not None:
            load_backbone(detector, backbone)
        begun = None if resume else start
        if begun is not None:
            weights_to_start, grown = widened(read_checkpoint(begun), detector)
            load_weights(detector, weights_to_start)
        frames = MixedFrames(
            sources,
            weights,
            maker=SampleMaker(chosen, tables),
            seed=seed,
            changes=changes,
            unlabelled=without_labels,
        )
        length = run_steps(
            chosen,
            steps=steps,
            epochs=epochs,
            epoch_samples=frames.epoch_length,
            batch_size=batch_size,
            before=length_before(out) if resume else None,
            done=first_step,
        )
        settings = RunSettings(
            steps=length,
            batch_size=batch_size,
            learning_rate=learning_rate or chosen.training.learning_rate,
            final_learning_rate=chosen.training.final_learning_rate,
            schedule=kind,
            warmup_steps=warmup if warmup is not None else (100 if kind == "hold" else 0),
            cooldown_steps=min(cooldown, length) if kind == "hold" else 0,
            workers=workers,
            seed=seed,
            device=own_device,
            mixed_precision=wants_mixed_precision(precision, own_device),
            average_decay=average_decay,
            freeze_norms=freeze_norms,
            quantize_aware=quantize_aware,
            weight_bits=weight_bits,
            paste=paste,
            zoom=zoom,
            faults=faults,
            unlabelled=tuple(unlabelled or ()),
            validate_every=validate_every or max(1, frames.epoch_length // batch_size),
        )
        metadata = {
            "preset": chosen.name,
            "method": method or "preset",
            "seed": str(seed),
            PRIORS_KEY: priors_digest(tables, chosen.classes),
            **rig_metadata(chosen),
        }
        validate = None
        if measured is not None:
            validate = Validation(
                detector,
                chosen,
                tables,
                frames=measured,
                run_dir=out,
                metadata=metadata,
                first_step=first_step,
                ranks=ranks,
            )
        if ranks.writes and before_cooldown:  # nothing is wrong any more
            back_to_hold(out)
        wait_for_all(ranks)
        if ranks.writes:  # from here on the folder is a run's
            record = origin_record(method=method, priors=origin, start=begun, backbone=backbone, validation=validation)
            write_settings(out, chosen, settings, dict(zip(dataset, weights, strict=True)), origin=record)
            keep_priors(out)
            card = None if resume else origin_card(start=begun, priors=priors, origin=origin)
            if card is not None:
                (out / CARD_FILE).write_text(card, encoding="utf-8")
        progress = TrainProgress(settings, samples=frames.epoch_length, shown=ranks.writes)
        notes = start_notes(begun, chosen, tables, backbone=backbone, resume=resume, grown=grown)
        if measured is not None:
            notes += overlap_notes(sources, measured)
        progress.tell(f"priors: {origin}", *(f"note: {text}" for text in notes))
        with progress:
            average = train(
                detector,
                chosen,
                frames,
                settings=settings,
                run_dir=out,
                resume=resume,
                on_step=progress.step,
                validate=validate,
                ranks=ranks,
            )
        if not ranks.writes:
            return
        if not all(torch.isfinite(value).all() for value in average.state.values() if value.is_floating_point()):
            raise CheckpointError(f"the run in {out} ended with weights that are not finite; lower --learning-rate")
        state = {name: value.cpu() for name, value in average.state.items()}
        save_weights(out / "weights.safetensors", state, metadata=metadata | {"steps": str(length)})
        progress.finish(out)
