"""YOLOMono3D, the monocular sibling: the detector without a right view (paper, section IV-C; official code)."""

from __future__ import annotations

import torch
from torch import nn

from edge.detector.backbone import ResNetBackbone
from edge.detector.head import AnchorHead
from edge.detector.presets import Preset


class MonoDetector(nn.Module):
    """Left picture in, head outputs out: backbone and head of the stereo detector, no neck, no disparity branch.

    Args:
        preset: shapes of all parts; its network has no neck.
    """

    def __init__(self, preset: Preset) -> None:
        super().__init__()
        shape = preset.network
        self.backbone = ResNetBackbone(shape.backbone_depth, shape.backbone_widths)
        self.head = AnchorHead(self.backbone.out_channels[2], preset.anchors.per_cell, len(preset.classes), shape.head)

    def forward(self, left: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised RGB (B, 3, H, W) to cls_logits (B, N, classes + 1) and box_deltas (B, N, 12)."""
        logits: torch.Tensor
        deltas: torch.Tensor
        logits, deltas = self.head(self.backbone(left)[2])
        return logits, deltas

    def forward_training(
        self, left: torch.Tensor, right: torch.Tensor | None = None
    ) -> tuple[torch.Tensor, torch.Tensor, None]:
        """As `forward`; a right view is not looked at, and there are no disparity logits."""
        return *self.forward(left), None
