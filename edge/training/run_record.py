"""What a run is: its settings, ``run.json`` that repeats it, and whether a resumed run is the same one."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from edge.detector.presets import Preset
from edge.training.checkpoint import CHECKPOINT_FILE, load_checkpoint
from edge.training.schedule import ScheduleKind
from runtime.contracts.errors import CheckpointError

SETTINGS_FILE = "run.json"
AVERAGE_DECAY = 0.99


@dataclass(frozen=True, slots=True)
class RunSettings:
    """What a run needs beside preset and data.

    Attributes:
        steps: optimisation steps of the whole run.
        batch_size: pairs a step, of all processes together.
        learning_rate, final_learning_rate: peak and end of the schedule.
        schedule: see `edge.training.schedule`; warmup_steps, cooldown_steps: its ends.
        workers: processes that read frames, for each training process.
        seed: of weights, order and augmentation.
        device: ``cpu``, ``cuda`` or ``cuda:N``.
        mixed_precision: bfloat16 where autocast takes it.
        checkpoint_every, log_every: steps between checkpoints and log lines.
        average_decay: of the average of the weights, which is what a run saves; 0 saves the last weights themselves.
            0.99 remembers the last hundred steps or so; one that reaches back before the cooldown (0.999 in a run of
            1,600 steps) was measured to be worse than the last weights.
        freeze_norms: all batch norms keep their statistics, not only the backbone's: for small batches.
        validate_every: steps between validations, 0 for none.
        quantize_aware: train under 8-bit rounding, see `edge.training.fake_quantisation`.
        weight_bits: of that rounding's weights, 8 or 7.
        paste, zoom, faults: shares of frames that are changed, see `edge.training.frame_changes`.
        unlabelled: sources that teach disparity alone.
    """

    steps: int
    batch_size: int
    learning_rate: float
    final_learning_rate: float
    schedule: ScheduleKind = "hold"
    warmup_steps: int = 100
    cooldown_steps: int = 0
    workers: int = 1
    seed: int = 0
    device: str = "cpu"
    mixed_precision: bool = True
    checkpoint_every: int = 100
    log_every: int = 10
    average_decay: float = AVERAGE_DECAY
    freeze_norms: bool = False
    validate_every: int = 0
    quantize_aware: bool = False
    weight_bits: int = 8
    paste: float = 0.0
    zoom: float = 0.0
    faults: float = 0.0
    unlabelled: tuple[str, ...] = ()


def write_settings(
    run_dir: Path, preset: Preset, settings: RunSettings, datasets: dict[str, int], *, origin: dict[str, Any]
) -> None:
    """Write all that is needed to repeat the run into ``run.json``, a stage for each start of the run.

    A resumed run may change its length, its datasets or its schedule: the stages say from which step on.

    Args:
        run_dir: the run's folder.
        preset, settings: of this stage.
        datasets: how often an epoch shows each.
        origin: what it began with, by name: method, priors, weights and their hashes, what it is validated on.
    """
    file = run_dir / SETTINGS_FILE
    record = json.loads(file.read_text()) if file.exists() else {"preset": _plain(preset), "stages": []}
    checkpoint = run_dir / CHECKPOINT_FILE
    stage = {
        "from_step": int(load_checkpoint(checkpoint)["step"]) if checkpoint.exists() else 0,
        "settings": asdict(settings),
        "datasets": datasets,
        "origin": origin,
        "torch": torch.__version__,
    }
    if _plain(preset) != record["preset"]:  # fields that a later version of the preset added
        stage["preset"] = _plain(preset)
    record["stages"].append(stage)
    file.write_text(json.dumps(record, indent=2) + "\n")


def length_before(run_dir: Path) -> int:
    """Steps that the run in a folder was to have when it was last started.

    Raises:
        CheckpointError: ``run.json`` is missing or describes no run.
    """
    return int(_last_record(run_dir)[1]["steps"])


def check_same_run(run_dir: Path, preset: Preset, *, seed: int, batch_size: int) -> None:
    """Refuse to resume a run of another preset, seed or batch size: its samples would not be the ones it saw.

    Fields that a preset did not have when the run began are passed over.

    Raises:
        CheckpointError: ``run.json`` is missing, or names another preset, seed or batch size.
    """
    known, earlier = _last_record(run_dir)
    differences = [
        *_differences(known, _plain(preset), "preset"),
        *_differences(int(earlier["seed"]), seed, "--seed"),
        *_differences(int(earlier["batch_size"]), batch_size, "--batch"),
    ]
    for what, before, now in differences:
        raise CheckpointError(
            f"{run_dir} was started with {what} {before}, found {now}, expected the same to resume; "
            "give what it was started with, or start a new run"
        )


def _last_record(run_dir: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The run's preset, and the settings of its last stage."""
    file = run_dir / SETTINGS_FILE
    try:
        record = json.loads(file.read_text())
        settings = record["stages"][-1]["settings"]
        int(settings["steps"]), int(settings["seed"]), int(settings["batch_size"])
        return _renamed(record["preset"]), dict(settings)
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        raise CheckpointError(
            f"{file} does not describe a run, expected one of `edge train`; start a new run"
        ) from None


def _renamed(preset: dict[str, Any]) -> dict[str, Any]:
    """A recorded preset by today's names: the kernel of both last layers was one field."""
    head = dict(preset["network"]["head"])
    if "final_kernel" in head:
        head["class_final_kernel"] = head["box_final_kernel"] = head.pop("final_kernel")
    return preset | {"network": preset["network"] | {"head": head}}


def _differences(before: Any, now: Any, where: str) -> list[tuple[str, Any, Any]]:
    """Where, what was, what is: of all that ``before`` knows."""
    if isinstance(before, dict) and isinstance(now, dict):
        inner = [_differences(value, now.get(key), f"{where}.{key}") for key, value in before.items()]
        return [item for items in inner for item in items]
    return [] if before == now else [(where, before, now)]


def _plain(preset: Preset) -> Any:
    return json.loads(json.dumps(asdict(preset)))
