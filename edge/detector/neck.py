"""The stereo neck: cost volumes at three scales, fused from fine to coarse.

Paper, section III-B3, hierarchical multi-scale fusion, and the ablations of section V-A.
"""

from __future__ import annotations

from typing import Literal

import torch
from torch import nn

from edge.detector.blocks import BasicBlock, GhostExpansion, conv_norm_relu
from edge.detector.concat_volume import ConcatVolume
from edge.detector.presets import NeckShape
from export.correlation import stereo_correlation


class ExpandAndMix(nn.Module):
    """Channel expansion, optional 2x2 average pooling, basic block.

    Args:
        in_channels, out_channels: before and after.
        pool: halve the size.
        expansion: see `NeckShape`. The module is called ``ghost`` whatever it is, as checkpoints name it.
    """

    def __init__(
        self, in_channels: int, out_channels: int, *, pool: bool, expansion: Literal["ghost", "naive", "none"] = "ghost"
    ) -> None:
        super().__init__()
        self.ghost: nn.Module
        if expansion == "ghost":
            self.ghost = GhostExpansion(in_channels)
        elif expansion == "naive":
            self.ghost = conv_norm_relu(in_channels, 3 * in_channels, kernel=1, bias=False)
        else:
            self.ghost = BasicBlock(in_channels, in_channels)
        self.pool = nn.AvgPool2d(2) if pool else nn.Identity()
        self.block = BasicBlock(in_channels if expansion == "none" else 3 * in_channels, out_channels)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, C, H, W) to (B, out, H / 2 or H, ...)."""
        out: torch.Tensor = self.block(self.pool(self.ghost(x)))
        return out


class StereoNeck(nn.Module):
    """Correlation at strides 4 and 8, concatenation at 16, and what joins them.

    Args:
        feature_widths: backbone channels at strides 4, 8, 16.
        shape: disparities and widths.
    """

    def __init__(self, feature_widths: tuple[int, int, int], shape: NeckShape) -> None:
        super().__init__()
        self.shape = shape
        at_8, at_16, out_channels = shape.widths
        self.concat_volume: ConcatVolume | None = None
        if shape.scale_16:
            self.concat_volume = ConcatVolume(feature_widths[2], shape.concat_features, shape.concat_shifts)
        self.four_to_eight = ExpandAndMix(shape.disparities_at_4, at_8, pool=True, expansion=shape.expansion)
        at_8 += shape.disparities_at_8 if shape.scale_8 else 0
        self.eight_to_sixteen = ExpandAndMix(at_8, at_16, pool=True, expansion=shape.expansion)
        at_16 += self.concat_volume.out_channels if self.concat_volume is not None else 0
        self.sixteen = ExpandAndMix(at_16, out_channels, pool=False, expansion=shape.expansion)

    def forward(self, left: tuple[torch.Tensor, ...], right: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Features of both views at strides 4, 8, 16 to (B, out_channels, H / 16, W / 16)."""
        volume4 = stereo_correlation(left[0], right[0], self.shape.disparities_at_4)
        volume8 = None
        if self.shape.scale_8:
            volume8 = stereo_correlation(left[1], right[1], self.shape.disparities_at_8)
        fused8 = self.four_to_eight(volume4)
        if volume8 is not None:
            fused8 = torch.cat([fused8, volume8], dim=1)
        fused16 = self.eight_to_sixteen(fused8)
        if self.concat_volume is not None:
            fused16 = torch.cat([fused16, self.concat_volume(left[2], right[2])], dim=1)
        out: torch.Tensor = self.sixteen(fused16)
        return out


class DisparityBranch(nn.Module):
    """Disparity logits at stride 4 from the fused stereo features; training only (paper, section III-C1)."""

    def __init__(self, in_channels: int, shape: NeckShape) -> None:
        super().__init__()
        first, second = shape.disparity_widths
        self.layers = nn.Sequential(
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(in_channels, first, 3, padding=1),
            nn.BatchNorm2d(first),
            nn.ReLU(inplace=True),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(first, second, 3, padding=1),
            nn.BatchNorm2d(second),
            nn.ReLU(inplace=True),
            nn.Conv2d(second, shape.disparity_classes, 1),
        )

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, C, H / 16, W / 16) to (B, disparity_classes, H / 4, W / 4)."""
        out: torch.Tensor = self.layers(x)
        return out
