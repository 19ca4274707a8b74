"""Convolution blocks that backbone, neck and heads share."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn


def conv_norm_relu(in_channels: int, out_channels: int, kernel: int = 3, **options: Any) -> nn.Sequential:
    """Convolution, batch norm, ReLU; padding keeps the size."""
    padding = options.pop("padding", kernel // 2)
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, kernel, padding=padding, **options),
        nn.BatchNorm2d(out_channels),
        nn.ReLU(inplace=True),
    )


def _shortcut(in_channels: int, out_channels: int, stride: int) -> nn.Module | None:
    """None (the identity), or a 1x1 convolution with norm where stride or width change."""
    if stride == 1 and in_channels == out_channels:
        return None
    return nn.Sequential(
        nn.Conv2d(in_channels, out_channels, 1, stride=stride, bias=False),
        nn.BatchNorm2d(out_channels),
    )


class BasicBlock(nn.Module):
    """Two 3x3 convolutions with a residual path (paper: ResNet basic block, also in the neck and the heads).

    The shortcut is the identity, or a 1x1 convolution with norm where stride or width change.
    """

    EXPANSION = 1

    def __init__(self, in_channels: int, out_channels: int, stride: int = 1) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, out_channels, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(out_channels)
        self.relu = nn.ReLU(inplace=True)
        self.conv2 = nn.Conv2d(out_channels, out_channels, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(out_channels)
        self.downsample = _shortcut(in_channels, out_channels, stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, in, H, W) to (B, out, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        inner = self.relu(self.bn1(self.conv1(x)))
        out: torch.Tensor = self.relu(self.bn2(self.conv2(inner)) + shortcut)
        return out


class Bottleneck(nn.Module):
    """1x1 down to ``width``, 3x3 with the stride, 1x1 up to four times ``width``; residual path (ResNet-50 and up)."""

    EXPANSION = 4

    def __init__(self, in_channels: int, width: int, stride: int = 1) -> None:
        super().__init__()
        out_channels = width * self.EXPANSION
        self.conv1 = nn.Conv2d(in_channels, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, out_channels, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(out_channels)
        self.relu = nn.ReLU(inplace=True)
        self.downsample = _shortcut(in_channels, out_channels, stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, in, H, W) to (B, 4 width, H / stride, W / stride)."""
        shortcut = x if self.downsample is None else self.downsample(x)
        inner = self.relu(self.bn1(self.conv1(x)))
        inner = self.relu(self.bn2(self.conv2(inner)))
        out: torch.Tensor = self.relu(self.bn3(self.conv3(inner)) + shortcut)
        return out


class GhostExpansion(nn.Module):
    """Triples the channels of a cost volume cheaply (paper, section III-B2, densely connected ghost module).

    ``[x, x1, x2]`` with x1 a 3x3 convolution of x and x2 a depthwise 3x3 convolution of x1; no biases.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.primary = conv_norm_relu(channels, channels, bias=False)
        self.cheap = conv_norm_relu(channels, channels, groups=channels, bias=False)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, C, H, W) to (B, 3 C, H, W)."""
        primary = self.primary(x)
        return torch.cat([x, primary, self.cheap(primary)], dim=1)
