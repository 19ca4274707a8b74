"""Identity and NumPy oracle of the two correlation operators.

The operators turn the features of a rectified pair into a volume of matching scores, one slice a disparity:
``volume[b, d, y, x] = mean over c of left[b, c, y, x] * right[b, c, y, x - d]``, and 0 where ``x < d``
(YOLOStereo3D, light-weight cost volume; as the official code computes it, a plain mean of products without a
division by feature norms). What is written here is what torch, the ONNX function body and the native kernel
are tested against; it is written for clarity, not for speed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FormatError

DOMAIN = "edge.stereo"
VERSION = 1
STEREO_CORRELATION = "StereoCorrelation"
QLINEAR_STEREO_CORRELATION = "QLinearStereoCorrelation"
MAX_DISPARITY = "max_disparity"
"""Name of the one attribute that both operators carry: how many disparities, D."""

Float32Array = NDArray[np.float32]
Int8Array = NDArray[np.integer[Any]]


def stereo_correlation(left: Float32Array, right: Float32Array, max_disparity: int) -> Float32Array:
    """Correlates two feature maps over disparities 0 .. max_disparity - 1.

    The products are accumulated in float64, so that the result is right to the last bit or nearly so whatever
    the number of channels.

    Args:
        left: Features of the left view, float32 [B, C, H, W].
        right: Features of the right view, float32 [B, C, H, W].
        max_disparity: D, in columns of the feature map, at least 1.

    Returns:
        The volume, float32 [B, D, H, W].

    Raises:
        FormatError: Unequal shapes, not four dimensions, no channel, or D below 1.
    """
    _check(left, right, max_disparity)
    batch, channels, height, width = left.shape
    volume = np.zeros((batch, max_disparity, height, width), np.float32)
    left64, right64 = left.astype(np.float64), right.astype(np.float64)
    for disparity in range(min(max_disparity, width)):
        products = left64[..., disparity:] * right64[..., : width - disparity]
        volume[:, disparity, :, disparity:] = products.sum(axis=1) / channels
    return volume


def qlinear_stereo_correlation(
    left: Int8Array,
    left_scale: np.float32 | float,
    left_zero_point: np.uint8 | np.int8,
    right: Int8Array,
    right_scale: np.float32 | float,
    right_zero_point: np.uint8 | np.int8,
    output_scale: np.float32 | float,
    output_zero_point: np.uint8 | np.int8,
    max_disparity: int,
) -> Int8Array:
    """Correlates two 8-bit feature maps; the argument order is that of the operator's inputs.

    ``acc = int32 sum over c of (l - zl)(r - zr)``,
    ``m = float32(float64(sl) * float64(sr) / (C * float64(so)))``,
    ``out = saturate(round_half_even(float32(acc) * m) + zo)``, and ``zo`` where ``x < d``.
    Every implementation gives these bits.

    Args:
        left: [B, C, H, W], uint8 or int8.
        left_scale: Scalar, taken as float32.
        left_zero_point: Scalar of the type of ``left``.
        right: [B, C, H, W], uint8 or int8.
        right_scale: Scalar, taken as float32.
        right_zero_point: Scalar of the type of ``right``.
        output_scale: Scalar, taken as float32.
        output_zero_point: Scalar uint8 or int8; its type is that of the result.
        max_disparity: D, in columns of the feature map, at least 1.

    Returns:
        The volume, [B, D, H, W] of the type of ``output_zero_point``.

    Raises:
        FormatError: Unequal shapes, not four dimensions, no channel, D below 1, or a zero point of another
            type than its tensor.
    """
    _check(left, right, max_disparity)
    zero_points = [np.asarray(zero) for zero in (left_zero_point, right_zero_point, output_zero_point)]
    for name, zero, dtype in zip(
        ("left", "right", "output"), zero_points, (left.dtype, right.dtype, zero_points[2].dtype), strict=True
    ):
        if zero.dtype != dtype or dtype not in (np.uint8, np.int8):
            raise FormatError(
                f"{name}_zero_point: found {zero.dtype} for a tensor of {dtype}; expected uint8 or int8, the"
                " same for both; make the zero point with the tensor's dtype"
            )
    batch, channels, height, width = left.shape
    output_dtype = zero_points[2].dtype
    zero_out = int(zero_points[2])
    scale = np.float64(np.float32(left_scale)) * np.float64(np.float32(right_scale))
    multiplier = np.float32(scale / (channels * np.float64(np.float32(output_scale))))

    left32 = left.astype(np.int32) - int(zero_points[0])
    right32 = right.astype(np.int32) - int(zero_points[1])
    limits = np.iinfo(output_dtype)
    volume: Int8Array = np.full((batch, max_disparity, height, width), zero_out, output_dtype)
    for disparity in range(min(max_disparity, width)):
        products = left32[..., disparity:] * right32[..., : width - disparity]
        accumulated = products.sum(axis=1, dtype=np.int32).astype(np.float32)
        rounded = np.rint(accumulated * multiplier)
        saturated = np.clip(rounded, limits.min - zero_out, limits.max - zero_out)
        volume[:, disparity, :, disparity:] = (saturated + zero_out).astype(output_dtype)
    return volume


def _check(left: NDArray[np.generic], right: NDArray[np.generic], max_disparity: int) -> None:
    if left.shape != right.shape or left.ndim != 4 or left.shape[1] < 1:
        raise FormatError(
            f"correlation inputs: found shapes {left.shape} and {right.shape}; expected [B, C, H, W] with C"
            " at least 1, the same for both; pass the two views of one batch"
        )
    if max_disparity < 1:
        raise FormatError(
            f"max_disparity: found {max_disparity}; expected at least 1; use the number of columns to search"
        )
