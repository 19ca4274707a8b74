"""The torch correlation: values, gradients, precision, and what training keeps in memory."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from runtime.contracts.correlation import stereo_correlation as oracle
from runtime.contracts.errors import FormatError

torch = pytest.importorskip("torch")
from export.correlation import StereoCorrelation, stereo_correlation  # noqa: E402

pytestmark = pytest.mark.torch

FLOAT32_SUM = 1e-6
"""Means of up to 64 products of order 1 in float32, against float64."""

SHAPES = [
    # batch, channels, height, width, disparities
    (1, 1, 1, 1, 1),
    (2, 3, 2, 5, 7),  # W < D
    (1, 13, 2, 6, 6),  # W = D
    (2, 64, 3, 37, 24),
]


def views(shape: tuple[int, ...], dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(2)
    left, right = torch.randn(2, *shape, generator=generator, dtype=dtype)
    return left, right


def test_empty_batch() -> None:
    left, right = views((0, 3, 2, 5))
    assert stereo_correlation(left, right, 4).shape == (0, 4, 2, 5)


@pytest.mark.parametrize(("batch", "channels", "height", "width", "disparities"), SHAPES)
def test_equals_the_oracle(batch: int, channels: int, height: int, width: int, disparities: int) -> None:
    left, right = views((batch, channels, height, width))
    volume = StereoCorrelation(disparities)(left, right)
    expected = oracle(left.numpy(), right.numpy(), disparities)
    np.testing.assert_allclose(volume.numpy(), expected, rtol=0, atol=FLOAT32_SUM, strict=True)


@pytest.mark.parametrize(("width", "disparities"), [(1, 1), (4, 6), (5, 5), (7, 3)])
def test_gradients_equal_finite_differences(width: int, disparities: int) -> None:
    left, right = (view.requires_grad_() for view in views((2, 3, 2, width), torch.float64))
    assert torch.autograd.gradcheck(lambda a, b: stereo_correlation(a, b, disparities), (left, right))


def test_channels_last_gives_the_same() -> None:
    left, right = views((2, 8, 4, 20))
    volume = stereo_correlation(left, right, 5)
    last = torch.channels_last
    again = stereo_correlation(left.to(memory_format=last), right.to(memory_format=last), 5)
    torch.testing.assert_close(again, volume, rtol=0, atol=FLOAT32_SUM)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_mean_is_float32_under_autocast(dtype: torch.dtype) -> None:
    left, right = (view.to(dtype).requires_grad_() for view in views((1, 64, 2, 16)))
    with torch.autocast("cpu", torch.bfloat16):
        volume = stereo_correlation(left, right, 4)
    assert volume.dtype == torch.float32
    expected = oracle(left.detach().float().numpy(), right.detach().float().numpy(), 4)
    np.testing.assert_allclose(volume.detach().numpy(), expected, rtol=0, atol=FLOAT32_SUM)
    volume.sum().backward()
    assert left.grad is not None and left.grad.dtype == dtype


def test_training_keeps_only_the_features() -> None:
    """Autograd left to itself would keep both shifted maps of every disparity."""
    left, right = (view.requires_grad_() for view in views((1, 8, 4, 32)))
    kept: list[int] = []
    with torch.autograd.graph.saved_tensors_hooks(lambda tensor: kept.append(tensor.numel()) or tensor, lambda x: x):
        stereo_correlation(left, right, 24)
    assert kept == [left.numel(), right.numel()]


def test_says_what_does_not_fit() -> None:
    left, right = views((1, 3, 2, 5))
    for wrong in ((left, right[..., :4], 2), (left[0], right[0], 2), (left, right, 0)):
        with pytest.raises(FormatError, match="expected the same"):
            stereo_correlation(*wrong)


def test_training_needs_no_onnx() -> None:
    code = (
        "import sys, torch; from export.correlation import stereo_correlation as f;"
        "x = torch.ones(1, 1, 1, 4, requires_grad=True); f(x, x, 2).sum().backward();"
        "print({'onnx', 'onnxruntime', 'onnxscript'} & set(sys.modules))"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"
