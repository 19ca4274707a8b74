"""From a tensor's statistics to the range that its 8 bits shall cover: four pure functions.

``minmax`` covers all that was seen. ``percentile`` leaves a fixed share of the values outside. ``mse``
weighs the rounding error of a wide range against the clipping error of a narrow one. ``entropy`` takes the
clipped range whose 8-bit distribution is closest to the values' own (Kullback-Leibler divergence; Migacz,
8-bit inference with TensorRT, 2017), here over both ends at once, so that signed tensors keep their
asymmetry.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from calib.observers import TensorStatistics
from runtime.contracts.errors import FormatError

LEVELS = 256
PERCENTILE = 99.999
"""Per cent of the values that ``percentile`` keeps inside, at each end."""

_SHRINKS = np.linspace(1.0, 0.1, 91)

Range = tuple[float, float]


def minmax_range(statistics: TensorStatistics) -> Range:
    """The exact extremes."""
    return statistics.minimum, statistics.maximum


def percentile_range(statistics: TensorStatistics, percentile: float = PERCENTILE) -> Range:
    """The values below which ``100 - percentile`` and ``percentile`` per cent lie, to one bin.

    Never outside the extremes.
    """
    cumulated = np.cumsum(statistics.counts)
    total = cumulated[-1]
    first = int(np.searchsorted(cumulated, total * (1 - percentile / 100), side="right"))
    last = int(np.searchsorted(cumulated, total * percentile / 100, side="left"))
    low = statistics.first_edge + first * statistics.bin_width
    high = statistics.first_edge + (last + 1) * statistics.bin_width
    return max(low, statistics.minimum), min(high, statistics.maximum)


def mse_range(statistics: TensorStatistics) -> Range:
    """The range with the least mean squared error of 256 levels.

    A value inside costs step^2 / 12 on average, a value outside its squared distance to the end. Values in
    the bin of zero cost nothing inside: zero is always one of the levels, and after a ReLU most values are
    zero.
    """
    centers, counts = statistics.centers, statistics.counts.astype(np.float64)
    rounded = np.where(np.abs(centers) <= 0.5 * statistics.bin_width, 0.0, counts)
    # Running sums from below, so that the cost of a range is a few look-ups.
    zeroth, first, second, inside = (
        np.concatenate([[0.0], np.cumsum(values)])
        for values in (counts, counts * centers, counts * centers**2, rounded)
    )

    def cost(low: float, high: float) -> float:
        start, stop = np.searchsorted(centers, [low, high], side="left")
        below = second[start] - 2 * low * first[start] + low**2 * zeroth[start]
        above = (
            (second[-1] - second[stop]) - 2 * high * (first[-1] - first[stop]) + high**2 * (zeroth[-1] - zeroth[stop])
        )
        step = (high - low) / (LEVELS - 1)
        return float(below + above + (inside[stop] - inside[start]) * step**2 / 12)

    return _best(statistics, cost)


def entropy_range(statistics: TensorStatistics) -> Range:
    """The range whose 256-level distribution diverges least from the values'."""
    centers, counts = statistics.centers, statistics.counts.astype(np.float64)
    # Zeros after a ReLU are exact in any range and would drown the rest.
    counts = np.where(np.abs(centers) <= 0.5 * statistics.bin_width, 0.0, counts)
    if counts.sum() == 0:
        return minmax_range(statistics)

    def cost(low: float, high: float) -> float:
        inside = (centers >= low) & (centers <= high)
        inner = counts[inside]
        if inner.size < LEVELS or inner.sum() == 0:
            return np.inf
        reference = inner.copy()
        reference[0] += counts[centers < low].sum()
        reference[-1] += counts[centers > high].sum()
        group = np.arange(inner.size) * LEVELS // inner.size
        used = inner > 0
        sums = np.bincount(group, weights=inner, minlength=LEVELS)
        slots = np.bincount(group, weights=used, minlength=LEVELS)
        spread = np.where(used, (sums / np.maximum(slots, 1))[group], 0.0)
        return _divergence(reference, spread)

    return _best(statistics, cost)


METHODS: dict[str, Callable[[TensorStatistics], Range]] = {
    "minmax": minmax_range,
    "percentile": percentile_range,
    "mse": mse_range,
    "entropy": entropy_range,
}
"""Range methods by the names that the command line takes."""


def tensor_range(statistics: TensorStatistics, method: str) -> Range:
    """The range of one tensor by a named method.

    Raises:
        FormatError: no such method.
    """
    if method not in METHODS:
        raise FormatError(f"--method: found {method!r}; expected one of {', '.join(METHODS)}; choose one of these")
    return METHODS[method](statistics)


def _best(statistics: TensorStatistics, cost: Callable[[float, float], float]) -> Range:
    """Tries narrower ends: both together first, then each alone around the best."""
    low, high = statistics.minimum, statistics.maximum
    if not low < high:
        return low, high
    common = min(_SHRINKS, key=lambda share: cost(low * share, high * share))
    best_high = min(_SHRINKS, key=lambda share: cost(low * common, high * share)) if high > 0 else common
    best_low = min(_SHRINKS, key=lambda share: cost(low * share, high * best_high)) if low < 0 else common
    return float(low * best_low), float(high * best_high)


def _divergence(reference: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    """Kullback-Leibler divergence of two histograms, in nats."""
    used = reference > 0
    if np.any(other[used] == 0):
        # An end bin that was empty but for clipped values: give it the least weight instead of refusing the
        # range.
        other = np.where(used & (other == 0), 1e-3, other)
    p, q = reference / reference.sum(), other / other.sum()
    return float((p[used] * np.log(p[used] / q[used])).sum())
