"""How long each stage took, as percentiles."""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

PERCENTILES = (50.0, 90.0, 99.0)


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


class LatencyLog:
    """Collects milliseconds by stage, in the order in which stages first appear."""

    def __init__(self) -> None:
        """Starts empty."""
        self._samples: dict[str, array[float]] = {}

    def add(self, latency_ms: Mapping[str, float]) -> None:
        """Note one frame's stages."""
        for stage, value in latency_ms.items():
            self._samples.setdefault(stage, array("d")).append(value)

    def summary(self) -> dict[str, LatencySummary]:
        """Percentiles by stage; empty before the first frame."""
        return {stage: summarize(samples) for stage, samples in self._samples.items()}


def summarize(samples_ms: array[float] | list[float]) -> LatencySummary:
    """Percentiles of at least one sample."""
    values = np.array(samples_ms, dtype=np.float64)
    p50, p90, p99 = (float(value) for value in np.percentile(values, PERCENTILES))
    return LatencySummary(len(values), p50, p90, p99, float(values.max()))
