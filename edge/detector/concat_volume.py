"""The small concatenation volume at stride 16 with its two 3D convolutions (paper, section III-B3)."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import nn

from edge.detector.blocks import conv_norm_relu


class ConcatVolume(nn.Module):
    """Left features beside right features shifted by d, mixed by two 3x3x3 convolutions.

    Args:
        in_channels: of the stride-16 features.
        features: channels after the shared 1x1 reduction.
        shifts: number of disparities, d = 0 .. shifts - 1 cells.
    """

    def __init__(self, in_channels: int, features: int, shifts: int) -> None:
        super().__init__()
        self.shifts = shifts
        self.out_channels = features * shifts
        self.reduce = conv_norm_relu(in_channels, features, kernel=1)
        self.conv3d = nn.Sequential(
            nn.Conv3d(2 * features, features, 3, padding=1),
            nn.BatchNorm3d(features),
            nn.ReLU(inplace=True),
            nn.Conv3d(features, features, 3, padding=1),
            nn.BatchNorm3d(features),
            nn.ReLU(inplace=True),
        )

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        """(B, in, H, W) twice to (B, features * shifts, H, W), channel = feature * shifts + d."""
        if self.training:  # each view's norm uses its own batch statistics, left first (official behaviour)
            left, right = self.reduce(left), self.reduce(right)
        else:
            left, right = self.reduce(torch.cat([left, right])).chunk(2)
        width = left.shape[-1]
        slices = []
        for d in range(self.shifts):
            pair = torch.cat([left[..., d:], right[..., : width - d]], dim=1)
            slices.append(F.pad(pair, (d, 0)))
        volume = self.conv3d(torch.stack(slices, dim=2))
        return volume.flatten(1, 2)
