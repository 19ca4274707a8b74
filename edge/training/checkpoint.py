"""Checkpoints that resume a run, written beside their place and renamed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn

from edge.training.distributed import Ranks, gathered
from runtime.contracts.errors import CheckpointError

CHECKPOINT_FILE, HOLD_CHECKPOINT_FILE = "checkpoint.pt", "checkpoint-hold.pt"
BEST_FILE = "best.safetensors"
"""Weights of the best validation."""


class AveragedModel:
    """Exponential moving average of a module's parameters; and norm statistics; counters are copied.

    Args:
        module: the module to follow.
        decay: of the average; early steps use a smaller one so that the start is forgotten.
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self._decay = decay
        self.state = {name: value.detach().clone() for name, value in module.state_dict().items()}

    def update(self, module: nn.Module, step: int) -> None:
        """Take in the module's state after a step."""
        decay = min(self._decay, (1 + step) / (10 + step))
        for name, value in module.state_dict().items():
            average = self.state[name]
            if average.dtype.is_floating_point:
                average.lerp_(value.detach(), 1 - decay)
            else:
                average.copy_(value)


def random_state(device: torch.device, ranks: Ranks) -> dict[str, Any]:
    """The generators of all processes (dropout draws from them) as entries of a checkpoint; each process calls it."""
    own = {"cpu": torch.get_rng_state()}
    if device.type == "cuda":
        own["cuda"] = torch.cuda.get_rng_state(device)
    everyone = gathered(own, ranks)
    return {
        "rng": everyone[0]["cpu"],
        "cuda_rng": [everyone[0]["cuda"]] if device.type == "cuda" else [],
        "rank_rng": everyone,
    }


def restore_random_state(state: dict[str, Any], device: torch.device, ranks: Ranks) -> None:
    """Set this process's generators; those of a run of other processes are seeded from where it stood."""
    everyone = state.get("rank_rng") or [{"cpu": state["rng"], "cuda": (state.get("cuda_rng") or [None])[0]}]
    if len(everyone) != ranks.count:
        seed = np.random.default_rng([int(state["step"]), ranks.count, ranks.rank]).integers(2**31)
        torch.manual_seed(int(seed))
        return
    own = everyone[ranks.rank]
    torch.set_rng_state(own["cpu"])
    if device.type == "cuda" and own.get("cuda") is not None:
        torch.cuda.set_rng_state(own["cuda"], device)


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint atomically."""
    beside = path.with_name(path.name + ".part")
    torch.save(state, beside)
    beside.replace(path)


def back_to_hold(run_dir: Path) -> None:
    """Let a run go on from before its cooldown.

    The checkpoint that it had lies beside as ``checkpoint-STEP.pt``, and what was best so far as
    ``best-STEP.safetensors``: later validations count anew.

    Raises:
        CheckpointError: the run kept none, since it has had no cooldown.
    """
    hold, now = load_hold(run_dir), load_checkpoint(run_dir / CHECKPOINT_FILE)
    step = int(now["step"])
    if step > int(hold["step"]):
        save_checkpoint(run_dir / f"checkpoint-{step}.pt", now)
        if (run_dir / BEST_FILE).is_file():
            shutil.copyfile(run_dir / BEST_FILE, run_dir / f"best-{step}.safetensors")
    save_checkpoint(run_dir / CHECKPOINT_FILE, hold)


def load_hold(run_dir: Path) -> dict[str, Any]:
    """The checkpoint from before a run's cooldown.

    Raises:
        CheckpointError: the run kept none, since it has had no cooldown.
    """
    hold = run_dir / HOLD_CHECKPOINT_FILE
    if not hold.is_file():
        raise CheckpointError(
            f"{hold} is not there, expected the checkpoint from before a cooldown; leave --before-cooldown out"
        )
    return load_checkpoint(hold)


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint without running anything that it holds.

    Raises:
        CheckpointError: missing or not a checkpoint of this project.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        raise CheckpointError(
            f"{path} is not there, expected a run's checkpoint; start the run without --resume"
        ) from None
    except Exception as error:
        raise CheckpointError(
            f"{path} is no checkpoint ({type(error).__name__}), expected one written by `edge train`; start a new run"
        ) from None
    missing = {"model", "average", "optimiser", "step"} - set(state)
    if missing:
        raise CheckpointError(
            f"{path} lacks {', '.join(sorted(missing))}, expected a run's checkpoint; start a new run"
        )
    return dict(state)
