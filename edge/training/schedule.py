"""Learning rates over a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Schedule:
    """Learning rate by step.

    ``cosine`` falls from ``peak`` to ``final`` over all steps (official: stepped per epoch, see `cosine_rate`).
    ``hold`` warms up, stays at ``peak`` and falls linearly to ``final`` over the last ``cooldown_steps``: a run can be
    lengthened from a checkpoint before its cooldown without having decided its length at the start.
    """

    kind: Literal["cosine", "hold"]
    peak: float
    final: float
    total_steps: int
    warmup_steps: int = 0
    cooldown_steps: int = 0

    def rate(self, step: int) -> float:
        """Learning rate of a step, counted from 0."""
        warm = min(1.0, (step + 1) / max(self.warmup_steps, 1))
        if self.kind == "cosine":
            return warm * cosine_rate(step, self.total_steps, peak=self.peak, final=self.final)
        left = (self.total_steps - step) / max(self.cooldown_steps, 1)
        return warm * (self.final + (self.peak - self.final) * min(1.0, max(left, 0.0)))


def cosine_rate(position: float, length: float, *, peak: float, final: float) -> float:
    """Half a cosine from ``peak`` at 0 to ``final`` at ``length``."""
    return final + 0.5 * (peak - final) * (1 + math.cos(math.pi * position / length))
