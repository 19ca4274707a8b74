"""The training loop (paper, section IV-A)."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from edge.detector.presets import Preset
from edge.training.checkpoint import (
    CHECKPOINT_FILE,
    HOLD_CHECKPOINT_FILE,
    AveragedModel,
    load_checkpoint,
    random_state,
    restore_random_state,
    save_checkpoint,
)
from edge.training.distributed import ALONE, Ranks, synchronised_norms, training_pass
from edge.training.event_log import EventLog
from edge.training.fake_quantisation import FakeQuantisation
from edge.training.run_log import LOG_FILE, RunLog
from edge.training.run_record import RunSettings
from edge.training.schedule import Schedule
from edge.training.step import train_step
from edge.training.stream import MixedFrames, batches


def train(
    detector: nn.Module,
    preset: Preset,
    frames: MixedFrames,
    *,
    settings: RunSettings,
    run_dir: Path,
    resume: bool,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, losses: None,
    validate: Callable[[dict[str, torch.Tensor], int], dict[str, float]] | None = None,
    ranks: Ranks = ALONE,
) -> AveragedModel:
    """Run to ``settings.steps``, writing checkpoint, ``log.csv`` and event files into ``run_dir``.

    A checkpoint is kept, too, from just before the cooldown (``checkpoint-hold.pt``), see `back_to_hold`.

    Args:
        detector: the network; its weights are where the run starts.
        preset: how it learns.
        frames: the samples by position.
        settings: the run.
        run_dir: an existing folder.
        resume: go on from its checkpoint.
        on_step: is told the step's number, from 1, and losses.
        validate: is given the averaged state and the step, every ``settings.validate_every`` steps and at the end;
            the numbers that it returns are logged.
        ranks: this process among those that train together; only the first writes.

    Returns:
        The averaged model.

    Raises:
        CheckpointError: ``resume`` without a checkpoint that fits.
        EdgeError: the batch cannot be shared by the processes.
    """
    device = torch.device(settings.device)
    detector.to(device)
    for module in detector.modules():
        if isinstance(module, nn.Conv2d):
            module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    for part in detector.backbone.parts()[: preset.training.frozen_backbone_parts]:  # type: ignore[union-attr, operator]
        part.requires_grad_(False)
    synchronised_norms(detector, ranks, device)
    parameters = [p for p in detector.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
    average = AveragedModel(detector, settings.average_decay)
    rounding = None
    if settings.quantize_aware:
        rounding = FakeQuantisation(detector, weight_bits=settings.weight_bits, ranks=ranks)
    step = 0

    def save(name: str) -> None:
        generators = random_state(device, ranks)
        if ranks.writes:
            state: dict[str, Any] = {
                "model": detector.state_dict(),
                "average": average.state,
                "optimiser": optimiser.state_dict(),
                "step": step,
                **generators,
            }
            if rounding is not None:
                state["rounding"] = rounding.state()
            save_checkpoint(run_dir / name, state)

    if resume:
        state = load_checkpoint(run_dir / CHECKPOINT_FILE)
        detector.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average.state = {name: value.to(device) for name, value in state["average"].items()}
        step = int(state["step"])
        restore_random_state(state, device, ranks)
        if rounding is not None and "rounding" in state:
            rounding.load_state(state["rounding"])
    else:
        if ranks.rank:  # same weights, other dropout
            torch.manual_seed(settings.seed + ranks.rank)
        save(CHECKPOINT_FILE)  # stopped early, it resumes from its start
    schedule = Schedule(
        kind=settings.schedule,
        peak=settings.learning_rate,
        final=settings.final_learning_rate,
        total_steps=settings.steps,
        warmup_steps=settings.warmup_steps,
        cooldown_steps=settings.cooldown_steps,
        batch_size=settings.batch_size,
        epoch_samples=frames.epoch_length,
    )
    loader = batches(
        frames,
        first_step=step,
        last_step=settings.steps,
        batch_size=settings.batch_size,
        workers=settings.workers,
        ranks=ranks,
    )
    forward = training_pass(detector, ranks, device)
    hold_end = settings.steps - settings.cooldown_steps
    log = None
    if ranks.writes:
        log = RunLog(run_dir / LOG_FILE, first_step=step, every=settings.log_every, batch_size=settings.batch_size)
    with EventLog(run_dir, first_step=step, enabled=ranks.writes) as events:
        for batch in loader:
            if settings.cooldown_steps and step == hold_end:
                save(HOLD_CHECKPOINT_FILE)
            rate = schedule.rate(step)
            for group in optimiser.param_groups:
                group["lr"] = rate
            if rounding is not None:
                rounding.begin_step()
            losses = train_step(
                detector,
                preset,
                batch.to(device),
                optimiser=optimiser,
                settings=settings,
                forward=forward,
                ranks=ranks,
            )
            if rounding is not None:
                rounding.end_step()
            epoch = schedule.epoch(step)
            step += 1
            average.update(detector, step)
            last = step == settings.steps
            row = log.add(step, rate, losses, last=last) if log is not None else None
            if row is not None:
                scalars = {f"train/{name}": value for name, value in row.items() if name != "step"}
                events.add(step, scalars | {"train/epoch": epoch})
            on_step(step, losses)
            if step % settings.checkpoint_every == 0 or last:
                save(CHECKPOINT_FILE)
            if validate is not None and ((settings.validate_every and step % settings.validate_every == 0) or last):
                began = time.monotonic()
                events.add(step, validate(average.state, step))
                if log is not None:
                    log.pause(time.monotonic() - began)
    if rounding is not None:
        rounding.remove()
    return average
