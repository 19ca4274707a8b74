"""The NumPy oracle against sums written out by hand."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from runtime.contracts.correlation import qlinear_stereo_correlation, stereo_correlation
from runtime.contracts.errors import FormatError

FLOAT32_ROUNDING = 1e-6
"""The oracle sums in float64 and rounds once; values are of order 1."""

SHAPES = [
    # batch, channels, height, width, disparities
    (1, 1, 1, 1, 1),
    (1, 1, 1, 1, 4),
    (2, 3, 2, 5, 7),  # W < D
    (1, 13, 2, 6, 6),  # W = D
    (3, 2, 1, 9, 4),
]


def features(shape: tuple[int, ...], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def test_empty_batch_gives_empty_volume() -> None:
    empty = np.zeros((0, 3, 4, 5), np.float32)
    assert stereo_correlation(empty, empty, 2).shape == (0, 2, 4, 5)


@pytest.mark.parametrize(("batch", "channels", "height", "width", "disparities"), SHAPES)
def test_equals_the_definition(batch: int, channels: int, height: int, width: int, disparities: int) -> None:
    left, right = (features((batch, channels, height, width), seed) for seed in (1, 2))
    volume = stereo_correlation(left, right, disparities)
    assert volume.dtype == np.float32 and volume.shape == (batch, disparities, height, width)
    for b, d, y, x in np.ndindex(volume.shape):
        if x < d:
            assert volume[b, d, y, x] == 0
            continue
        products = [float(left[b, c, y, x]) * float(right[b, c, y, x - d]) for c in range(channels)]
        assert volume[b, d, y, x] == pytest.approx(sum(products) / channels, abs=FLOAT32_ROUNDING)


def test_finds_a_shift() -> None:
    right = features((1, 16, 3, 40), 5)
    left = np.roll(right, 6, axis=3)
    assert (stereo_correlation(left, right, 12)[0, :, :, 12:].argmax(axis=0) == 6).all()


@pytest.mark.parametrize("types", [*itertools.product((np.uint8, np.int8), repeat=3)])
@pytest.mark.parametrize(("batch", "channels", "height", "width", "disparities"), SHAPES)
def test_quantized_equals_the_definition(
    types: tuple[type, type, type], batch: int, channels: int, height: int, width: int, disparities: int
) -> None:
    rng = np.random.default_rng(7)
    left, right, zeros = quantized_inputs(rng, types, (batch, channels, height, width))
    scales = np.array([0.021, 0.034, 0.021 * 0.034 * 60], np.float32)
    volume = qlinear_stereo_correlation(
        left, scales[0], zeros[0], right, scales[1], zeros[1], scales[2], zeros[2], disparities
    )
    limits = np.iinfo(types[2])
    multiplier = np.float32(float(scales[0]) * float(scales[1]) / (channels * float(scales[2])))
    assert volume.dtype == types[2] and volume.shape == (batch, disparities, height, width)
    for b, d, y, x in np.ndindex(volume.shape):
        total = 0
        for c in range(channels if x >= d else 0):
            total += (int(left[b, c, y, x]) - int(zeros[0])) * (int(right[b, c, y, x - d]) - int(zeros[1]))
        expected = round(float(np.float32(total) * multiplier)) + int(zeros[2])  # half to even, as Python's
        assert volume[b, d, y, x] == min(max(expected, limits.min), limits.max)


@pytest.mark.parametrize(("total", "expected"), [(1, 0), (3, 2), (5, 2), (7, 4), (-1, 0), (-3, -2)])
def test_halves_go_to_even(total: int, expected: int) -> None:
    left, right = np.full((1, 1, 1, 1), total, np.int8), np.ones((1, 1, 1, 1), np.int8)
    zero = np.int8(0)
    assert qlinear_stereo_correlation(left, 0.5, zero, right, 1.0, zero, 1.0, zero, 1).item() == expected


def test_saturates_and_fills_the_border_with_the_zero_point() -> None:
    bright, dark = np.full((1, 4, 1, 2), 255, np.uint8), np.zeros((1, 4, 1, 2), np.uint8)
    zero, zero_out = np.uint8(128), np.uint8(10)
    same = qlinear_stereo_correlation(bright, 1.0, zero, bright, 1.0, zero, 1.0, zero_out, 2)
    other = qlinear_stereo_correlation(bright, 1.0, zero, dark, 1.0, zero, 1.0, zero_out, 2)
    assert same[0, :, 0].tolist() == [[255, 255], [10, 255]]
    assert other[0, :, 0].tolist() == [[0, 0], [10, 0]]


def test_says_what_does_not_fit() -> None:
    views = features((1, 2, 3, 4), 0)
    with pytest.raises(FormatError, match=r"\(1, 2, 3, 4\) and \(1, 2, 3, 3\)"):
        stereo_correlation(views, views[..., :3], 2)
    with pytest.raises(FormatError, match="C at least 1"):
        stereo_correlation(views[:, :0], views[:, :0], 2)
    with pytest.raises(FormatError, match="max_disparity: found 0"):
        stereo_correlation(views, views, 0)
    bytes_ = np.zeros((1, 2, 3, 4), np.uint8)
    with pytest.raises(FormatError, match="right_zero_point: found int8 for a tensor of uint8"):
        qlinear_stereo_correlation(bytes_, 1.0, np.uint8(0), bytes_, 1.0, np.int8(0), 1.0, np.uint8(0), max_disparity=2)


def quantized_inputs(
    rng: np.random.Generator, types: tuple[type, type, type], shape: tuple[int, ...]
) -> tuple[np.ndarray, np.ndarray, list[np.generic]]:
    """Both views over the whole range of their type, and three zero points."""
    ranges = [(np.iinfo(kind).min, np.iinfo(kind).max + 1) for kind in types]
    left, right = (
        rng.integers(*limits, shape).astype(kind) for limits, kind in zip(ranges[:2], types[:2], strict=True)
    )
    zeros = [kind(rng.integers(*limits)) for limits, kind in zip(ranges, types, strict=True)]
    return left, right, zeros
