"""How long each stage took, as percentiles."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

PERCENTILES = (50.0, 90.0, 99.0)
KEPT_SAMPLES = 100_000
"""Frames that percentiles look back over: 0.8 MB a stage, 2.8 hours at 10 Hz."""


@dataclass(frozen=True, slots=True)
class LatencySummary:
    """Milliseconds of one stage over all frames.

    Attributes:
        count: frames; p50, p90, p99: percentiles, linearly interpolated; largest: the slowest frame.
    """

    count: int
    p50: float
    p90: float
    p99: float
    largest: float


@dataclass(slots=True)
class _Stage:
    """The latest samples of a stage, in a ring, and what is known of all of them."""

    latest: array[float] = field(default_factory=lambda: array("d"))
    count: int = 0
    largest: float = -np.inf


class LatencyLog:
    """Collects milliseconds by stage, in the order in which stages first appear.

    Memory is bounded, so that a camera may run for weeks: count and largest are of all frames, percentiles of the
    latest ``kept`` frames alone. A shorter recording's are exact.

    Args:
        kept: frames that percentiles look back over.
    """

    def __init__(self, *, kept: int = KEPT_SAMPLES) -> None:
        """Starts empty."""
        self._kept = kept
        self._stages: dict[str, _Stage] = {}

    def add(self, latency_ms: Mapping[str, float]) -> None:
        """Note one frame's stages."""
        for name, value in latency_ms.items():
            stage = self._stages.setdefault(name, _Stage())
            if len(stage.latest) < self._kept:
                stage.latest.append(value)
            else:
                stage.latest[stage.count % self._kept] = value
            stage.count += 1
            stage.largest = max(stage.largest, value)

    def summary(self) -> dict[str, LatencySummary]:
        """Figures by stage; empty before the first frame."""
        return {
            name: replace(summarize(stage.latest), count=stage.count, largest=stage.largest)
            for name, stage in self._stages.items()
        }


def summarize(samples_ms: array[float] | list[float]) -> LatencySummary:
    """Percentiles of at least one sample."""
    values = np.array(samples_ms, dtype=np.float64)
    p50, p90, p99 = (float(value) for value in np.percentile(values, PERCENTILES))
    return LatencySummary(len(values), p50, p90, p99, float(values.max()))
