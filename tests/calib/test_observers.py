"""Streaming statistics against NumPy on all values at once."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from calib.observers import ChannelExtremes, StreamingHistogram
from runtime.contracts.errors import FormatError

EDGE_SLACK = 1e-5
"""Edges are handed to OpenCV in float32: relative to the span."""

pieces = st.lists(
    hnp.arrays(np.float32, st.integers(1, 40), elements=st.floats(-1e4, 1e4, width=32)), min_size=1, max_size=6
)


@settings(max_examples=200)
@given(arrays=pieces)
def test_nothing_is_lost_and_extremes_are_exact(arrays) -> None:
    histogram = StreamingHistogram(bins=64)
    for values in arrays:
        histogram.update(values)
    statistics, everything = histogram.statistics(), np.concatenate(arrays)
    assert statistics.counts.sum() == everything.size
    assert statistics.minimum == everything.min()
    assert statistics.maximum == everything.max()


@settings(max_examples=200)
@given(arrays=pieces)
def test_each_bin_holds_what_numpy_says(arrays) -> None:
    """Cumulated counts at each edge, give or take values that lie on the edge to float32."""
    histogram = StreamingHistogram(bins=64)
    for values in arrays:
        histogram.update(values)
    statistics = histogram.statistics()
    everything = np.sort(np.concatenate(arrays).astype(np.float64))
    span = statistics.bin_width * len(statistics.counts)
    edges = statistics.first_edge + statistics.bin_width * np.arange(1, len(statistics.counts) + 1)
    cumulated = np.cumsum(statistics.counts)
    slack = EDGE_SLACK * max(span, float(np.abs(everything).max()))
    assert (cumulated >= np.searchsorted(everything, edges - slack)).all()
    assert (cumulated <= np.searchsorted(everything, edges + slack, side="right")).all()


def test_growing_keeps_at_least_half_of_the_bins_in_use() -> None:
    histogram = StreamingHistogram(bins=1024)
    random = np.random.default_rng(0)
    for scale in (1, 3, 10, 0.1, 40):
        histogram.update(random.normal(0, scale, 5000).astype(np.float32))
    statistics = histogram.statistics()
    assert statistics.maximum - statistics.minimum > 0.25 * statistics.bin_width * 1024  # grown to both sides
    assert statistics.counts.sum() == 25_000


def test_zeros_first_and_values_later() -> None:
    histogram = StreamingHistogram()
    histogram.update(np.zeros(100, np.float32))
    histogram.update(np.linspace(0, 5, 100, dtype=np.float32))
    statistics = histogram.statistics()
    assert statistics.counts.sum() == 200
    assert (statistics.minimum, statistics.maximum) == (0.0, 5.0)


def test_memory_does_not_grow_with_the_values() -> None:
    histogram = StreamingHistogram(bins=128)
    for _ in range(20):
        histogram.update(np.random.default_rng(0).normal(0, 1, (2, 3, 50, 50)).astype(np.float32))
    assert histogram.statistics().counts.nbytes == 128 * 8


def test_empty_and_broken_input() -> None:
    histogram = StreamingHistogram()
    histogram.update(np.zeros(0, np.float32))
    with pytest.raises(FormatError, match="no values"):
        histogram.statistics()
    for value in (np.nan, np.inf):
        with pytest.raises(FormatError, match="conv1: found a value that is not finite"):
            histogram.update(np.array([1.0, value], np.float32), name="conv1")
    for bins in (0, 3):
        with pytest.raises(FormatError, match="even number"):
            StreamingHistogram(bins)


def test_channel_extremes_are_numpys() -> None:
    extremes, random = ChannelExtremes(), np.random.default_rng(1)
    arrays = [random.normal(0, 1, (2, 5, 4, 3)).astype(np.float32) for _ in range(3)]
    with pytest.raises(FormatError, match="no values"):
        extremes.extremes()
    for values in arrays:
        extremes.update(values)
    low, high = extremes.extremes()
    everything = np.concatenate(arrays)
    np.testing.assert_array_equal(low, everything.min(axis=(0, 2, 3)))
    np.testing.assert_array_equal(high, everything.max(axis=(0, 2, 3)))
