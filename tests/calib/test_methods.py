"""Ranges by each method, against NumPy on all values at once."""

from __future__ import annotations

import numpy as np
import pytest

from calib.methods import METHODS, PERCENTILE, entropy_range, mse_range, percentile_range, tensor_range
from calib.observers import StreamingHistogram, TensorStatistics
from quantize.qparams import activation_params
from runtime.contracts.errors import FormatError

BINS_OFF = 2
"""A percentile is known to one bin at each side."""
MSE_SLACK = 1.05
"""The search tries shrinks in steps of one per cent and takes errors from a histogram: within 5 % of the best."""


def statistics_of(values: np.ndarray) -> TensorStatistics:
    histogram = StreamingHistogram()
    for part in np.array_split(values.astype(np.float32), 7):
        histogram.update(part)
    return histogram.statistics()


def gaussian(count: int = 200_000) -> np.ndarray:
    return np.random.default_rng(0).normal(0.3, 1.0, count)


def rectified(count: int = 200_000) -> np.ndarray:
    return np.maximum(gaussian(count), 0)


def heavy_tailed(count: int = 200_000) -> np.ndarray:
    return np.random.default_rng(2).standard_t(3, count)


def error_of(values: np.ndarray, low: float, high: float) -> float:
    params = activation_params(low, high)
    return float(((params.dequantize(params.quantize(values)) - values) ** 2).mean())


@pytest.mark.parametrize("method", sorted(METHODS))
@pytest.mark.parametrize("values", [gaussian(), rectified(), heavy_tailed(), -rectified()])
def test_ranges_lie_within_the_extremes(method, values) -> None:
    low, high = tensor_range(statistics_of(values), method)
    assert np.float32(values.min()) <= low <= high <= np.float32(values.max())


@pytest.mark.parametrize("method", sorted(METHODS))
@pytest.mark.parametrize("value", [0.0, 3.0, -2.0])
def test_a_constant_tensor_keeps_its_value(method, value) -> None:
    low, high = tensor_range(statistics_of(np.full(1000, value)), method)
    assert low <= value <= high


def test_minmax_is_exact() -> None:
    values = gaussian().astype(np.float32)
    assert tensor_range(statistics_of(values), "minmax") == (values.min(), values.max())


@pytest.mark.parametrize("percentile", [90.0, 99.0, 99.9])
def test_percentiles_are_numpys_to_a_bin(percentile) -> None:
    values = heavy_tailed()
    statistics = statistics_of(values)
    low, high = percentile_range(statistics, percentile)
    expected = np.percentile(values, [100 - percentile, percentile])
    assert np.abs(np.array([low, high]) - expected).max() <= BINS_OFF * statistics.bin_width


def test_the_default_percentile_cuts_one_in_a_hundred_thousand() -> None:
    values = np.concatenate([rectified(400_000), [1000.0]])
    assert pytest.approx(99.999) == PERCENTILE
    assert percentile_range(statistics_of(values))[1] < 10


@pytest.mark.parametrize("values", [rectified(), heavy_tailed(), gaussian()])
def test_mse_finds_the_least_error(values) -> None:
    found = error_of(values, *mse_range(statistics_of(values)))
    shrinks = np.linspace(0.05, 1, 60)
    best = min(error_of(values, values.min() * s, values.max() * s) for s in shrinks)
    assert found <= MSE_SLACK * best


@pytest.mark.parametrize("values", [heavy_tailed(), np.maximum(heavy_tailed(), 0)])
def test_heavy_tails_are_cut(values) -> None:
    statistics = statistics_of(values)
    assert mse_range(statistics)[1] < values.max()
    assert error_of(values, *mse_range(statistics)) < error_of(values, values.min(), values.max())
    assert entropy_range(statistics)[1] < 0.5 * values.max()


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(FormatError, match="minmax"):
        tensor_range(statistics_of(gaussian(10)), "guess")
