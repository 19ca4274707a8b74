"""The shared image backbone: a ResNet of basic or bottleneck blocks, stages 1 to 3 (paper, section III-C)."""

from __future__ import annotations

import torch
from torch import nn

from edge.detector.blocks import BasicBlock, Bottleneck

Block = type[BasicBlock] | type[Bottleneck]
LAYOUT_BY_DEPTH: dict[int, tuple[Block, tuple[int, int, int]]] = {
    18: (BasicBlock, (2, 2, 2)),
    34: (BasicBlock, (3, 4, 6)),
    50: (Bottleneck, (3, 4, 6)),
    101: (Bottleneck, (3, 4, 23)),
}
"""Kind of block and blocks a stage, stages 1 to 3."""


class ResNetBackbone(nn.Module):
    """Features at strides 4, 8 and 16; the fourth stage is left out.

    Module names are torchvision's, so that ImageNet weights load by name.

    Args:
        depth: 18 or 34 (basic blocks), 50 or 101 (bottlenecks).
        widths: channels inside the three stages (64, 128, 256 for the standard networks); basic blocks give as many,
            bottlenecks four times as many.

    Attributes:
        out_channels: of the features at strides 4, 8, 16.
    """

    def __init__(self, depth: int, widths: tuple[int, int, int]) -> None:
        super().__init__()
        block, counts = LAYOUT_BY_DEPTH[depth]
        self.out_channels = feature_widths(depth, widths)
        self.conv1 = nn.Conv2d(3, widths[0], 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(widths[0])
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        at_4, at_8, _ = self.out_channels
        self.layer1 = _stage(block, widths[0], widths[0], counts[0], 1)
        self.layer2 = _stage(block, at_4, widths[1], counts[1], 2)
        self.layer3 = _stage(block, at_8, widths[2], counts[2], 2)

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """(B, 3, H, W) normalised RGB to features at strides 4, 8, 16."""
        stride4 = self.layer1(self.maxpool(self.relu(self.bn1(self.conv1(image)))))
        stride8 = self.layer2(stride4)
        return stride4, stride8, self.layer3(stride8)

    def parts(self) -> list[nn.Module]:
        """Stem, then the three stages: what a preset freezes from the front."""
        return [nn.ModuleList([self.conv1, self.bn1]), self.layer1, self.layer2, self.layer3]


def feature_widths(depth: int, widths: tuple[int, int, int]) -> tuple[int, int, int]:
    """Channels that a backbone of this depth and these stage widths gives at strides 4, 8, 16."""
    block, _ = LAYOUT_BY_DEPTH[depth]
    first, second, third = (width * block.EXPANSION for width in widths)
    return first, second, third


def _stage(block: Block, in_channels: int, width: int, count: int, stride: int) -> nn.Sequential:
    first = block(in_channels, width, stride)
    return nn.Sequential(first, *(block(width * block.EXPANSION, width) for _ in range(count - 1)))
