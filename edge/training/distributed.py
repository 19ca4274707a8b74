"""Several processes that train as one: `torchrun`, DistributedDataParallel, and the normalisers they share.

A step of R processes equals a step of one process with the joint batch. The losses are not plain means over samples:
images weigh by their objects, disparities may count valid pixels only. Each process therefore scales its own loss so
that the mean over processes, which DistributedDataParallel takes of the gradients, is the loss of the joint batch.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from runtime.contracts.errors import EdgeError


@dataclass(frozen=True, slots=True)
class Ranks:
    """This process among those of the run.

    Attributes:
        rank: 0 .. count - 1; only 0 writes.
        count: processes of the run.
        local_rank: the process on its machine, which is its GPU.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0

    @property
    def writes(self) -> bool:
        """Whether this is the process that owns the files."""
        return self.rank == 0

    def share_of(self, joint_batch_size: int) -> int:
        """Samples of a joint batch that each process takes.

        Raises:
            EdgeError: they cannot be shared equally.
        """
        if joint_batch_size % self.count:
            raise EdgeError(
                f"--batch is {joint_batch_size} for {self.count} processes, expected a multiple of their number; "
                "--batch counts the pairs of all processes together"
            )
        return joint_batch_size // self.count


ALONE = Ranks()


def ranks_of_environment() -> Ranks:
    """What `torchrun` says of this process; alone without it."""
    return Ranks(
        rank=int(os.environ.get("RANK", 0)),
        count=int(os.environ.get("WORLD_SIZE", 1)),
        local_rank=int(os.environ.get("LOCAL_RANK", 0)),
    )


@contextmanager
def process_group(device: str) -> Iterator[tuple[Ranks, str]]:
    """Join the processes that `torchrun` started, for as long as the context lasts.

    Args:
        device: ``cpu`` (backend gloo) or ``cuda`` (backend nccl, one GPU a process).

    Yields:
        This process, and the device that it uses.
    """
    ranks = ranks_of_environment()
    if ranks.count == 1:
        yield ranks, device
        return
    if device == "cuda":
        device = f"cuda:{ranks.local_rank}"
        torch.cuda.set_device(ranks.local_rank)
    dist.init_process_group("nccl" if device.startswith("cuda") else "gloo")
    try:
        yield ranks, device
    finally:
        dist.destroy_process_group()


def synchronised_norms(detector: nn.Module, ranks: Ranks, device: torch.device) -> None:
    """On GPUs, let batch norms of several processes share their statistics; names of the state stay the same.

    PyTorch has none for CPUs: there each process normalises by its own share, as with that batch size alone.
    """
    if ranks.count > 1 and device.type == "cuda":
        nn.SyncBatchNorm.convert_sync_batchnorm(detector)


class TrainingPass(nn.Module):
    """``forward_training`` as a forward, which is what DistributedDataParallel watches."""

    def __init__(self, detector: nn.Module) -> None:
        super().__init__()
        self.detector = detector

    def forward(self, *views: torch.Tensor) -> Any:
        """Head outputs and disparity logits of normalised views."""
        return self.detector.forward_training(*views)  # type: ignore[operator]


def training_pass(detector: nn.Module, ranks: Ranks, device: torch.device) -> nn.Module:
    """The module that a step calls; with several processes its backward averages their gradients."""
    inner = TrainingPass(detector)
    if ranks.count == 1:
        return inner
    return DistributedDataParallel(inner, device_ids=[device.index] if device.type == "cuda" else None)


def joint_sum(values: Mapping[str, float], ranks: Ranks, device: torch.device) -> dict[str, float]:
    """Sum numbers over all processes, in float64."""
    if ranks.count == 1:
        return dict(values)
    packed = torch.tensor(list(values.values()), dtype=torch.float64, device=device)
    dist.all_reduce(packed)
    return dict(zip(values, packed.tolist(), strict=True))


def share_of_denominator(own: float, joint: float, ranks: Ranks) -> float:
    """Factor that turns sum / own into the process's part of sum / joint, so that the mean over processes is exact."""
    return 1.0 if ranks.count == 1 else ranks.count * own / joint


def gathered(value: Any, ranks: Ranks) -> list[Any]:
    """One object of each process, in the order of ranks, for all of them."""
    if ranks.count == 1:
        return [value]
    everyone: list[Any] = [None] * ranks.count
    dist.all_gather_object(everyone, value)
    return everyone


def spread(state: Mapping[str, torch.Tensor], ranks: Ranks) -> None:
    """Overwrite tensors with those of rank 0."""
    if ranks.count > 1:
        for value in state.values():
            dist.broadcast(value, src=0)


def wait_for_all(ranks: Ranks) -> None:
    """Go on when every process has come here."""
    if ranks.count > 1:
        dist.barrier()
