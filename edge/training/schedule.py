"""Learning rates over a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from runtime.contracts.errors import EdgeError

ScheduleKind = Literal["cosine", "cosine-step", "hold"]
SCHEDULES: tuple[ScheduleKind, ...] = ("hold", "cosine", "cosine-step")


def schedule_kind(word: str) -> ScheduleKind:
    """The schedule of that name.

    Raises:
        EdgeError: there is none.
    """
    for kind in SCHEDULES:
        if word == kind:
            return kind
    raise EdgeError(f"--schedule is {word!r}, expected {', '.join(SCHEDULES)}; choose one")


@dataclass(frozen=True, slots=True)
class Schedule:
    """Learning rate by step.

    ``cosine`` falls from ``peak`` to ``final``, one value an epoch (paper, section IV-A; official code).
    ``cosine-step`` is the same curve, moved on at every step.
    ``hold`` warms up, stays at ``peak`` and falls linearly to ``final`` over the last ``cooldown_steps``: a run can be
    lengthened from a checkpoint before its cooldown without having decided its length at the start.

    Attributes:
        batch_size, epoch_samples: what tells the epoch of a step; an epoch of None samples is the whole run.
    """

    kind: ScheduleKind
    peak: float
    final: float
    total_steps: int
    warmup_steps: int = 0
    cooldown_steps: int = 0
    batch_size: int = 1
    epoch_samples: int | None = None

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        warm = min(1.0, (step + 1) / max(self.warmup_steps, 1))
        if self.kind == "cosine-step":
            return warm * cosine_rate(step, self.total_steps, peak=self.peak, final=self.final)
        if self.kind == "cosine":
            return warm * cosine_rate(self.epoch(step), self.epochs, peak=self.peak, final=self.final)
        left = (self.total_steps - step) / max(self.cooldown_steps, 1)
        return warm * (self.final + (self.peak - self.final) * min(1.0, max(left, 0.0)))

    def epoch(self, step: int) -> int:
        """The epoch of a step's first sample."""
        return 0 if self.epoch_samples is None else step * self.batch_size // self.epoch_samples

    @property
    def epochs(self) -> int:
        """Whole epochs of the run, at least one."""
        return max(1, self.epoch(self.total_steps))


def steps_of(epochs: int, *, epoch_samples: int, batch_size: int) -> int:
    """Steps that show every sample ``epochs`` times; the last batch may reach into the next epoch."""
    return math.ceil(epochs * epoch_samples / batch_size)


def cosine_rate(position: float, length: float, *, peak: float, final: float) -> float:
    """Half a cosine from ``peak`` at 0 to ``final`` at ``length``."""
    return final + 0.5 * (peak - final) * (1 + math.cos(math.pi * position / length))
