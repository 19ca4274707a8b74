"""The training loop (paper, section III-D)."""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import nn

from edge.detector.network import StereoDetector
from edge.detector.presets import Preset
from edge.training.checkpoint import CHECKPOINT_FILE, AveragedModel, load_checkpoint, save_checkpoint
from edge.training.losses import box_loss, class_loss, disparity_loss
from edge.training.schedule import Schedule
from edge.training.stream import Batch, MixedFrames, batches
from runtime.contracts.errors import CheckpointError

LOG_FILE, SETTINGS_FILE = "log.csv", "run.json"
LOG_COLUMNS = (
    "step",
    "learning_rate",
    "class_loss",
    "box_loss",
    "disparity_loss",
    "gradient_norm",
    "samples_per_sec",
)
AVERAGE_DECAY = 0.999


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run needs beside preset and data."""

    steps: int
    batch_size: int
    learning_rate: float
    final_learning_rate: float
    schedule: Literal["cosine", "hold"] = "hold"
    warmup_steps: int = 100
    cooldown_steps: int = 0
    workers: int = 1
    seed: int = 0
    device: str = "cpu"
    mixed_precision: bool = True
    checkpoint_every: int = 100
    log_every: int = 10


def train(
    detector: StereoDetector,
    preset: Preset,
    frames: MixedFrames,
    *,
    settings: RunSettings,
    run_dir: Path,
    resume: bool,
    on_step: Callable[[int, dict[str, float]], None] = lambda step, losses: None,
) -> AveragedModel:
    """Run to ``settings.steps``, writing ``checkpoint.pt`` and ``log.csv`` into ``run_dir``.

    A checkpoint is kept, too, from just before the cooldown (``checkpoint-hold.pt``): a later run can go on from it.

    Returns:
        The averaged model.
    """
    device = torch.device(settings.device)
    detector.to(device).train()
    for module in detector.modules():
        if isinstance(module, nn.Conv2d):
            module.to(memory_format=torch.channels_last)
    for part in detector.backbone.parts()[: preset.training.frozen_backbone_parts]:
        part.requires_grad_(False)
    parameters = [p for p in detector.parameters() if p.requires_grad]
    optimiser = torch.optim.Adam(parameters, lr=settings.learning_rate)
    average = AveragedModel(detector, AVERAGE_DECAY)
    step = 0
    if resume:
        state = load_checkpoint(run_dir / CHECKPOINT_FILE)
        detector.load_state_dict(state["model"])
        optimiser.load_state_dict(state["optimiser"])
        average.state = {name: value.to(device) for name, value in state["average"].items()}
        torch.set_rng_state(state["rng"])
        if device.type == "cuda" and state.get("cuda_rng"):
            torch.cuda.set_rng_state_all(state["cuda_rng"])
        step = int(state["step"])
    else:
        _save(run_dir / CHECKPOINT_FILE, detector, average, optimiser, step)  # stopped early, it resumes from its start
    schedule = Schedule(
        kind=settings.schedule,
        peak=settings.learning_rate,
        final=settings.final_learning_rate,
        total_steps=settings.steps,
        warmup_steps=settings.warmup_steps,
        cooldown_steps=settings.cooldown_steps,
    )
    log = _Log(run_dir / LOG_FILE, settings.log_every, settings.batch_size)
    loader = batches(
        frames,
        first_step=step,
        last_step=settings.steps,
        batch_size=settings.batch_size,
        workers=settings.workers,
    )
    hold_end = settings.steps - settings.cooldown_steps
    for batch in loader:
        if settings.cooldown_steps and step == hold_end:
            _save(run_dir / "checkpoint-hold.pt", detector, average, optimiser, step)
        rate = schedule.rate(step)
        for group in optimiser.param_groups:
            group["lr"] = rate
        losses = train_step(detector, preset, batch.to(device), optimiser=optimiser, settings=settings)
        step += 1
        average.update(detector, step)
        log.add(step, rate, losses)
        on_step(step, losses)
        if step % settings.checkpoint_every == 0 or step == settings.steps:
            _save(run_dir / CHECKPOINT_FILE, detector, average, optimiser, step)
    return average


def train_step(
    detector: StereoDetector,
    preset: Preset,
    batch: Batch,
    *,
    optimiser: torch.optim.Optimizer,
    settings: RunSettings,
) -> dict[str, float]:
    """One optimisation step; the backbone's norms stay in evaluation mode (official behaviour)."""
    detector.backbone.eval()
    device_type = batch.left.device.type
    with torch.autocast(device_type, dtype=torch.bfloat16, enabled=settings.mixed_precision):
        logits, deltas, disparity = detector.forward_training(batch.left, batch.right)
    logits, deltas, disparity = logits.float(), deltas.float(), disparity.float()
    weights = logits.new_tensor(preset.training.class_weights)
    classes = class_loss(logits[..., :-1], batch.targets, weights)
    boxes = box_loss(logits[..., -1], deltas, batch.targets, z_weight=preset.training.z_weight)
    disparities = disparity_loss(disparity, batch.disparity)
    total = classes + boxes
    if boxes.detach() > 0:  # official: an object-free batch does not teach disparity
        total = total + preset.training.disparity_weight * disparities
    optimiser.zero_grad(set_to_none=True)
    total.backward()
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    norm = torch.nn.utils.clip_grad_norm_(parameters, preset.training.gradient_clip_norm)
    optimiser.step()
    return {
        "class_loss": float(classes.detach()),
        "box_loss": float(boxes.detach()),
        "disparity_loss": float(disparities.detach()),
        "gradient_norm": float(norm),
    }


def _save(path: Path, detector: nn.Module, average: AveragedModel, optimiser: torch.optim.Optimizer, step: int) -> None:
    state: dict[str, Any] = {
        "model": detector.state_dict(),
        "average": average.state,
        "optimiser": optimiser.state_dict(),
        "rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "step": step,
    }
    save_checkpoint(path, state)


class _Log:
    """Means over ``every`` steps, one CSV line each."""

    def __init__(self, path: Path, every: int, batch_size: int) -> None:
        self._path = path
        self._every = every
        self._batch_size = batch_size
        self._sums: dict[str, float] = {}
        self._count = 0
        self._since = time.monotonic()
        if not path.exists():
            with path.open("w", newline="") as stream:
                csv.writer(stream).writerow(LOG_COLUMNS)

    def add(self, step: int, rate: float, losses: dict[str, float]) -> None:
        self._count += 1
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        if step % self._every:
            return
        now = time.monotonic()
        means = {name: value / self._count for name, value in self._sums.items()}
        row = {
            "step": step,
            "learning_rate": rate,
            "samples_per_sec": self._batch_size * self._count / (now - self._since),
            **means,
        }
        with self._path.open("a", newline="") as stream:
            csv.writer(stream).writerow([f"{row[column]:.6g}" for column in LOG_COLUMNS])
        self._sums, self._count, self._since = {}, 0, now


def write_settings(run_dir: Path, preset: Preset, settings: RunSettings, datasets: dict[str, int]) -> None:
    """Write all that is needed to repeat the run into ``run.json``, a stage for each start of the run.

    A resumed run may change its length, its datasets or its schedule: the stages say from which step on.
    """
    file = run_dir / SETTINGS_FILE
    record = json.loads(file.read_text()) if file.exists() else {"preset": _plain(preset), "stages": []}
    checkpoint = run_dir / CHECKPOINT_FILE
    stage = {
        "from_step": int(load_checkpoint(checkpoint)["step"]) if checkpoint.exists() else 0,
        "settings": asdict(settings),
        "datasets": datasets,
        "torch": torch.__version__,
    }
    record["stages"].append(stage)
    file.write_text(json.dumps(record, indent=2) + "\n")


def check_same_run(run_dir: Path, preset: Preset, settings: RunSettings) -> None:
    """Refuse to resume a run of another preset, seed or batch size: its samples would not be the ones it saw.

    Raises:
        CheckpointError: ``run.json`` is missing, or names another preset, seed or batch size.
    """
    file = run_dir / SETTINGS_FILE
    try:
        record = json.loads(file.read_text())
        earlier = record["stages"][-1]["settings"]
        before = (record["preset"], earlier["seed"], earlier["batch_size"])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        raise CheckpointError(
            f"{file} does not describe a run, expected one of `edge train`; start a new run"
        ) from None
    now = (_plain(preset), settings.seed, settings.batch_size)
    for what, old, new in zip(("preset", "--seed", "--batch"), before, now, strict=True):
        if old != new:
            raise CheckpointError(
                f"{run_dir} was started with another {what}, expected the same to resume; "
                "give what it was started with, or start a new run"
            )


def _plain(preset: Preset) -> Any:
    return json.loads(json.dumps(asdict(preset)))
