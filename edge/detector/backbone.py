"""The shared image backbone: a ResNet of basic blocks, stages 1 to 3 (paper, section III-A)."""

from __future__ import annotations

import torch
from torch import nn

from edge.detector.blocks import BasicBlock

BLOCKS_BY_DEPTH = {18: (2, 2, 2), 34: (3, 4, 6)}


class ResNetBackbone(nn.Module):
    """Features at strides 4, 8 and 16; the fourth stage is left out.

    Module names are torchvision's, so that ImageNet weights load by name.

    Args:
        depth: 18 or 34.
        widths: channels of the three stages (64, 128, 256 for the standard networks).
    """

    def __init__(self, depth: int, widths: tuple[int, int, int]) -> None:
        super().__init__()
        counts = BLOCKS_BY_DEPTH[depth]
        self.conv1 = nn.Conv2d(3, widths[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = _stage(widths[0], widths[0], counts[0], 1)
        self.layer2 = _stage(widths[0], widths[1], counts[1], 2)
        self.layer3 = _stage(widths[1], widths[2], counts[2], 2)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B, 3, H, W) normalised RGB to features at strides 4, 8, 16."""
        stride4 = self.layer1(self.maxpool(self.relu(self.bn1(self.conv1(image)))))
        stride8 = self.layer2(stride4)
        return stride4, stride8, self.layer3(stride8)

    def parts(self) -> list[nn.Module]:
        """Stem, then the three stages: what a preset freezes from the front."""
        return [nn.ModuleList([self.conv1, self.bn1]), self.layer1, self.layer2, self.layer3]


def _stage(in_channels: int, out_channels: int, count: int, stride: int) -> nn.Sequential:
    first = BasicBlock(in_channels, out_channels, stride)
    return nn.Sequential(first, *(BasicBlock(out_channels, out_channels) for _ in range(count - 1)))
