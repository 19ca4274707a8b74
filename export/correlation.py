"""The correlation volume as plain differentiable torch, which becomes one custom ONNX node while exporting.

Training and evaluation use it as it stands and need no onnx. Under ``torch.onnx.export`` the same call
leaves a single ``edge.stereo::StereoCorrelation`` node in the graph. The mean over channels is taken in
float32, also under autocast, where float16 or bfloat16 would lose the small differences between disparities.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from runtime.contracts.correlation import DOMAIN, MAX_DISPARITY, STEREO_CORRELATION, VERSION
from runtime.contracts.errors import FormatError


def stereo_correlation(left: Tensor, right: Tensor, max_disparity: int) -> Tensor:
    """Correlates two feature maps over disparities 0 .. max_disparity - 1.

    ``volume[b, d, y, x] = mean over c of left[b, c, y, x] * right[b, c, y, x - d]``, and 0 where ``x < d``.

    Args:
        left: Features of the left view, [B, C, H, W], floating point.
        right: Features of the right view, [B, C, H, W].
        max_disparity: D, in columns of the feature map, at least 1.

    Returns:
        The volume, [B, D, H, W]: float64 for float64 features, else float32.

    Raises:
        FormatError: Unequal shapes, not four dimensions, or D below 1.
    """
    if left.shape != right.shape or left.dim() != 4 or max_disparity < 1:
        raise FormatError(
            f"correlation: found shapes {tuple(left.shape)} and {tuple(right.shape)}, max_disparity"
            f" {max_disparity}; expected the same [B, C, H, W] twice and at least 1; pass both views"
        )
    if torch.onnx.is_in_onnx_export():
        batch, _, height, width = left.shape
        volume: Tensor = torch.onnx.ops.symbolic(
            f"{DOMAIN}::{STEREO_CORRELATION}",
            (left, right),
            {MAX_DISPARITY: max_disparity},
            dtype=left.dtype,
            shape=(batch, max_disparity, height, width),
            version=VERSION,
        )
        return volume
    result: Tensor = _Correlation.apply(left, right, max_disparity)
    return result


class StereoCorrelation(nn.Module):
    """``stereo_correlation`` with its number of disparities, as a layer without parameters."""

    def __init__(self, max_disparity: int) -> None:
        """Takes D, the number of disparities, in columns of the feature map."""
        super().__init__()
        self.max_disparity = max_disparity

    def forward(self, left: Tensor, right: Tensor) -> Tensor:
        """Features [B, C, H, W] of both views to the volume [B, D, H, W]."""
        return stereo_correlation(left, right, self.max_disparity)

    def extra_repr(self) -> str:
        """Shows D where the module is printed."""
        return f"max_disparity={self.max_disparity}"


class _Correlation(torch.autograd.Function):
    """Saves the two feature maps and nothing else.

    Left to autograd, every disparity would keep its own shifted copies of both maps until the backward pass,
    D times the memory of the features. One disparity is computed at a time, the gradients in place.
    """

    @staticmethod
    def forward(ctx: Any, left: Tensor, right: Tensor, max_disparity: int) -> Tensor:
        ctx.save_for_backward(left, right)
        left, right = _accurate(left), _accurate(right)
        batch, _, height, width = left.shape
        volume = left.new_zeros((batch, max_disparity, height, width))
        for disparity in range(min(max_disparity, width)):
            products = left[..., disparity:] * right[..., : width - disparity]
            volume[:, disparity, :, disparity:] = products.mean(dim=1)
        return volume

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_volume: Tensor) -> tuple[Tensor, Tensor, None]:
        saved_left, saved_right = ctx.saved_tensors
        left, right = _accurate(saved_left), _accurate(saved_right)
        grad_products = grad_volume / left.shape[1]
        grad_left, grad_right = torch.zeros_like(left), torch.zeros_like(right)
        width = left.shape[3]
        for disparity in range(min(grad_volume.shape[1], width)):
            grad_slice = grad_products[:, disparity : disparity + 1, :, disparity:]
            grad_left[..., disparity:].addcmul_(right[..., : width - disparity], grad_slice)
            grad_right[..., : width - disparity].addcmul_(left[..., disparity:], grad_slice)
        return grad_left.to(saved_left.dtype), grad_right.to(saved_right.dtype), None


def _accurate(features: Tensor) -> Tensor:
    return features if features.dtype == torch.float64 else features.float()
