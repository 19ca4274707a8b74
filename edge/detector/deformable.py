"""Deformable convolution, modulated: a 3x3 convolution that looks where the image tells it to.

The official monocular head begins with one; the paper of this detector does not mention it. Plain differentiable
torch, which becomes one ``DeformConv`` node of ONNX (opset 19) under ``torch.onnx.export``.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn

KERNEL = 3
TAPS = KERNEL * KERNEL
OFFSETS = 2 * TAPS
ONNX_OPSET = 19
"""First with ``DeformConv``."""


class DeformableConv2d(nn.Module):
    """3x3 convolution whose taps are shifted and weighed at every place.

    A second 3x3 convolution (``conv_offset``) predicts 27 numbers a place: channels 2 t and 2 t + 1 are the row and
    column shifts of tap t, taps row by row; the last nine, through a sigmoid, are the taps' weights. Reading between
    cells is bilinear, beyond the image 0. ``conv_offset`` starts at 0: a plain convolution at half strength.

    Args:
        in_channels, out_channels: of the features.

    Attributes:
        weight: (out, in, 3, 3); bias: (out,). Names are the official code's.
    """

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, KERNEL, KERNEL))
        self.bias = nn.Parameter(torch.zeros(out_channels))
        self.conv_offset = nn.Conv2d(in_channels, OFFSETS + TAPS, KERNEL, padding=KERNEL // 2)
        nn.init.uniform_(self.weight, -1 / math.sqrt(in_channels * TAPS), 1 / math.sqrt(in_channels * TAPS))
        nn.init.zeros_(self.conv_offset.weight)
        assert self.conv_offset.bias is not None
        nn.init.zeros_(self.conv_offset.bias)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, in, H, W) to (B, out, H, W)."""
        predicted = self.conv_offset(x)
        offset, mask = predicted[:, :OFFSETS], torch.sigmoid(predicted[:, OFFSETS:])
        if torch.onnx.is_in_onnx_export():
            node: torch.Tensor = torch.onnx.ops.symbolic(
                "DeformConv",
                (x, self.weight, offset, self.bias, mask),
                {"kernel_shape": [KERNEL, KERNEL], "pads": [KERNEL // 2] * 4},
                dtype=x.dtype,
                shape=(x.shape[0], self.weight.shape[0], *x.shape[2:]),
                version=ONNX_OPSET,
            )
            return node
        return deformable_conv2d(x, self.weight, self.bias, offset=offset, mask=mask)


def deformable_conv2d(
    x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor, *, offset: torch.Tensor, mask: torch.Tensor
) -> torch.Tensor:
    """``out[p] = bias + sum over taps t of mask_t[p] * weight_t x(p + place_t + offset_t[p])``.

    One tap at a time: nine times the features would be several hundred megabytes for the backward pass alone.
    Positions and sums are float32, also under autocast, where a shift of a cell would be rounded to a hundredth.

    Args:
        x: (B, in, H, W).
        weight: (out, in, 3, 3); bias: (out,).
        offset: (B, 18, H, W), row and column shift of each tap, in cells.
        mask: (B, 9, H, W).

    Returns:
        (B, out, H, W), float64 for float64 features, else float32.
    """
    with torch.autocast(x.device.type, enabled=False):
        x, weight, bias, offset, mask = (
            value if value.dtype == torch.float64 else value.float() for value in (x, weight, bias, offset, mask)
        )
        height, width = x.shape[2:]
        rows = torch.arange(height, device=x.device, dtype=x.dtype)[None, :, None]
        columns = torch.arange(width, device=x.device, dtype=x.dtype)[None, None, :]
        out = bias[None, :, None, None].expand(x.shape[0], -1, height, width)
        for tap in range(TAPS):
            row = rows + (tap // KERNEL - KERNEL // 2) + offset[:, 2 * tap]
            column = columns + (tap % KERNEL - KERNEL // 2) + offset[:, 2 * tap + 1]
            grid = torch.stack([(2 * column + 1) / width - 1, (2 * row + 1) / height - 1], dim=-1)
            read = F.grid_sample(x, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
            out = out + F.conv2d(read * mask[:, tap : tap + 1], weight[:, :, tap // KERNEL, tap % KERNEL, None, None])
        return out
