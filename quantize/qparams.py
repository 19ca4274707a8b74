"""Scales and zero points.

``real = scale * (quantised - zero_point)``. Zero is always one of the levels, since padding and ReLU make
it the most frequent value of all. A value inside the range is off by at most half a step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from quantize.errors import QuantizeError

ActivationType = Literal["uint8", "int8"]
SMALLEST_SCALE = float(np.finfo(np.float32).tiny) * 2**24
"""Far above where float32 loses bits, far below any activation."""

_INT32_HEADROOM = 2.0**30
_LIMITS = {"uint8": (0, 255), "int8": (-128, 127)}


@dataclass(frozen=True, slots=True)
class QuantParams:
    """Of one tensor.

    Attributes:
        scale: float32 value, positive.
        zero_point: the level that stands for 0.
        dtype: numpy name of the 8-bit type.
    """

    scale: float
    zero_point: int
    dtype: ActivationType

    def quantize(self, values: NDArray[Any]) -> NDArray[Any]:
        """Round half to even and saturate, as QuantizeLinear does."""
        low, high = _LIMITS[self.dtype]
        levels = np.rint(np.asarray(values, np.float32) / np.float32(self.scale)) + self.zero_point
        clipped: NDArray[Any] = np.clip(levels, low, high).astype(self.dtype)
        return clipped

    def dequantize(self, levels: NDArray[Any]) -> NDArray[np.float32]:
        """As DequantizeLinear does."""
        return (levels.astype(np.int32) - self.zero_point).astype(np.float32) * np.float32(self.scale)


def activation_params(
    low: float, high: float, *, dtype: ActivationType = "uint8", symmetric: bool = False
) -> QuantParams:
    """Scale and zero point of an activation whose values lie in [low, high], widened to hold zero.

    Args:
        low: Smallest value to represent.
        high: Largest value to represent.
        dtype: 8-bit type.
        symmetric: Zero in the middle (int8: level 0, uint8: level 128).

    Raises:
        QuantizeError: The range is not finite or upside down.
    """
    if not (np.isfinite(low) and np.isfinite(high) and low <= high):
        raise QuantizeError(f"range: found [{low}, {high}]; expected finite numbers in rising order; calibrate again")
    low, high = min(low, 0.0), max(high, 0.0)
    first, last = _LIMITS[dtype]
    if symmetric:
        middle = (first + last + 1) // 2
        scale = np.float32(max(max(-low, high) / (last - middle), SMALLEST_SCALE))
        return QuantParams(float(scale), middle, dtype)
    scale = np.float32(max((high - low) / (last - first), SMALLEST_SCALE))
    zero_point = int(np.clip(np.rint(first - low / float(scale)), first, last))
    return QuantParams(float(scale), zero_point, dtype)


def largest_level(bits: int) -> int:
    """Of a symmetric weight: 127 of 8 bits, 63 of 7."""
    return int(2 ** (bits - 1) - 1)


def weight_scales(weight: NDArray[np.float32], *, bits: int, per_channel: bool) -> NDArray[np.float32]:
    """Symmetric scales of a weight: (M,) by output channel (axis 0), or () for the whole.

    Args:
        weight: Float weight.
        bits: 8 (levels -127 .. 127) or 7 (-63 .. 63).
        per_channel: One scale an output channel.
    """
    largest = largest_level(bits)
    axes = tuple(range(1, weight.ndim)) if per_channel else None
    peaks = np.abs(weight).max(axis=axes)
    return np.asarray(np.maximum(peaks.astype(np.float64) / largest, SMALLEST_SCALE), np.float32)


def quantize_weight(weight: NDArray[np.float32], scales: NDArray[np.float32], *, bits: int) -> NDArray[np.int8]:
    """Nearest level, round half to even."""
    largest = largest_level(bits)
    shape = (-1, *[1] * (weight.ndim - 1)) if scales.ndim else ()
    levels = np.rint(weight.astype(np.float64) / scales.astype(np.float64).reshape(shape))
    return np.clip(levels, -largest, largest).astype(np.int8)


def scales_that_hold_bias(
    scales: NDArray[np.float32], bias: NDArray[np.float64], input_scale: float
) -> NDArray[np.float32]:
    """Weight scales, widened where ``bias / (input scale * weight scale)`` would leave int32.

    That happens in channels whose weights are next to nothing while their bias is not: their weights round
    to zero then, and nothing is lost.
    """
    needed = np.abs(bias) / (_INT32_HEADROOM * input_scale)
    return np.maximum(scales, needed.astype(np.float32))


def quantize_bias(
    bias: NDArray[np.float64], input_scale: float, scales: NDArray[np.float32]
) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """Bias as int32 at scale ``input_scale * weight scale``: values and scales, by output channel."""
    combined = (np.float64(input_scale) * scales.astype(np.float64)).astype(np.float32)
    return np.rint(bias / combined.astype(np.float64)).astype(np.int32), combined
