"""Scales and zero points: zero is a level, and no value is off by more than half a step."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quantize.errors import QuantizeError
from quantize.qparams import (
    activation_params,
    quantize_bias,
    quantize_weight,
    scales_that_hold_bias,
    weight_scales,
)

HALF_STEP = 0.5 * (1 + 1e-4)
"""Half a step, and the rounding of float32 divisions of numbers up to 255."""

finite = st.floats(-1e6, 1e6, allow_nan=False, width=32)


@pytest.mark.parametrize(("dtype", "symmetric"), [("uint8", False), ("int8", False), ("int8", True), ("uint8", True)])
@given(ends=st.tuples(finite, finite), share=st.floats(0, 1))
def test_error_is_at_most_half_a_step(dtype, symmetric, ends, share) -> None:
    low, high = sorted(ends)
    params = activation_params(low, high, dtype=dtype, symmetric=symmetric)
    value = np.float32(low + share * (high - low))
    found = params.dequantize(params.quantize(np.array([value])))[0]
    slack = params.scale  # the zero point is rounded, so each end can lie up to one step outside the levels
    inside = min(low, 0) + slack <= value <= max(high, 0) - slack
    if inside:
        assert abs(float(found) - float(value)) <= HALF_STEP * params.scale
    else:
        assert abs(float(found) - float(value)) <= (0.5 + HALF_STEP) * params.scale


@given(ends=st.tuples(finite, finite))
def test_zero_is_exact(ends) -> None:
    params = activation_params(*sorted(ends))
    assert params.dequantize(params.quantize(np.zeros(1)))[0] == 0.0


def test_nothing_but_zero_still_gives_a_scale() -> None:
    params = activation_params(0.0, 0.0)
    assert params.scale > 0
    assert params.zero_point == 0


def test_a_relu_output_begins_at_level_zero() -> None:
    assert activation_params(0.0, 3.0).zero_point == 0
    assert activation_params(0.0, 3.0, dtype="int8").zero_point == -128


@pytest.mark.parametrize("ends", [(1.0, -1.0), (float("nan"), 1.0), (0.0, float("inf"))])
def test_a_wrong_range_is_refused(ends) -> None:
    with pytest.raises(QuantizeError, match="expected finite numbers"):
        activation_params(*ends)


@pytest.mark.parametrize(("bits", "largest"), [(8, 127), (7, 63)])
def test_weights_use_the_bits_and_are_off_by_half_a_step(bits, largest) -> None:
    weight = np.random.default_rng(0).normal(0, 1, (5, 4, 3, 3)).astype(np.float32)
    weight[2] = 0  # a dead channel
    scales = weight_scales(weight, bits=bits, per_channel=True)
    levels = quantize_weight(weight, scales, bits=bits)
    assert levels.dtype == np.int8
    assert np.abs(levels).max() == largest
    error = np.abs(levels * scales.reshape(-1, 1, 1, 1) - weight)
    assert (error <= HALF_STEP * scales.reshape(-1, 1, 1, 1)).all()
    assert (levels[2] == 0).all()


def test_one_scale_for_all_channels() -> None:
    weight = np.array([[1.0, -2.0], [0.5, 0.25]], np.float32)
    scales = weight_scales(weight, bits=8, per_channel=False)
    assert scales.shape == ()
    assert quantize_weight(weight, scales, bits=8)[0, 1] == -127


def test_a_bias_that_would_overflow_widens_its_channels_scale() -> None:
    scales = np.array([1e-20, 1e-3], np.float32)
    bias = np.array([5.0, 5.0])
    widened = scales_that_hold_bias(scales, bias, input_scale=0.02)
    levels, combined = quantize_bias(bias, 0.02, widened)
    assert widened[1] == scales[1]
    assert np.abs(levels * combined.astype(np.float64) - bias).max() <= HALF_STEP * combined.max()
