"""The anchor head: class and box branches over every cell (paper, sections III-A1 and III-C)."""

from __future__ import annotations

import math

import torch
from torch import nn

from edge.detector.blocks import BasicBlock, conv_norm_relu
from edge.detector.deformable import DeformableConv2d
from edge.detector.presets import HeadShape
from runtime.boxcode import DELTA_COUNT


class AnchorHead(nn.Module):
    """Predicts, for each anchor, a logit a class, a facing logit, and the 12 numbers of a box.

    The last convolutions start at weight 0; with ``shape.initial_probability`` the class biases start at its logit,
    so that the first steps are not spent on pushing a million background anchors down.

    Args:
        in_channels: of the features at stride 16.
        anchors_per_cell: K.
        class_count: without the facing logit.
        shape: widths of the branches.
    """

    def __init__(self, in_channels: int, anchors_per_cell: int, class_count: int, shape: HeadShape) -> None:
        super().__init__()
        self.logit_count = class_count + 1
        width = shape.class_width
        self.classification = nn.Sequential(
            nn.Conv2d(in_channels, width, 3, padding=1),
            nn.Dropout2d(shape.dropout),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1),
            nn.Dropout2d(shape.dropout),
            nn.ReLU(inplace=True),
            _final(width, anchors_per_cell * self.logit_count, shape.class_final_kernel),
        )
        box_width = shape.box_width or in_channels
        final = _final(box_width, anchors_per_cell * DELTA_COUNT, shape.box_final_kernel)
        if shape.deformable:
            self.regression = nn.Sequential(
                DeformableConv2d(in_channels, box_width),
                nn.BatchNorm2d(box_width),
                nn.ReLU(inplace=True),
                nn.Conv2d(box_width, box_width, 3, padding=1),
                nn.BatchNorm2d(box_width),
                nn.ReLU(inplace=True),
                final,
            )
        else:
            self.regression = nn.Sequential(
                conv_norm_relu(in_channels, box_width),
                BasicBlock(box_width, box_width),
                nn.ReLU(),  # of a ReLU: kept for the official layer numbering
                final,
            )
        if shape.initial_probability is not None:
            bias = self.classification[-1].bias.data.view(anchors_per_cell, self.logit_count)  # type: ignore[union-attr, operator]
            bias[:, :-1] = math.log(shape.initial_probability / (1 - shape.initial_probability))

    def forward(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(B, C, rows, columns) to (B, N, classes + 1) and (B, N, 12), N = rows x columns x anchors a cell."""
        logits = _by_anchor(self.classification(features), self.logit_count)
        return logits, _by_anchor(self.regression(features), DELTA_COUNT)


class _FullPrecisionConv2d(nn.Conv2d):
    """A convolution that leaves mixed precision: bfloat16 would round logits to steps of 0.03."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        with torch.autocast(x.device.type, enabled=False):
            return super().forward(x.float())


def _final(in_channels: int, out_channels: int, kernel: int) -> nn.Conv2d:
    layer = _FullPrecisionConv2d(in_channels, out_channels, kernel, padding=kernel // 2)
    nn.init.zeros_(layer.weight)
    assert layer.bias is not None
    nn.init.zeros_(layer.bias)
    return layer


def _by_anchor(maps: torch.Tensor, numbers: int) -> torch.Tensor:
    """(B, K * numbers, rows, columns) to (B, rows * columns * K, numbers)."""
    return maps.permute(0, 2, 3, 1).reshape(maps.shape[0], -1, numbers)
