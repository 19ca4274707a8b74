"""YOLOStereo3D as one module (paper, section III-C, figure 1)."""

from __future__ import annotations

import torch
from torch import nn

from edge.detector.backbone import ResNetBackbone
from edge.detector.head import AnchorHead
from edge.detector.neck import DisparityBranch, StereoNeck
from edge.detector.presets import Preset


class StereoDetector(nn.Module):
    """Stereo pair in, head outputs out.

    Both views pass the backbone as one batch: one set of weights in the exported graph, one wide convolution on the
    device.

    Args:
        preset: shapes of all parts.
    """

    def __init__(self, preset: Preset) -> None:
        super().__init__()
        shape = preset.network
        self.backbone = ResNetBackbone(shape.backbone_depth, shape.backbone_widths)
        self.neck = StereoNeck(self.backbone.out_channels, shape.neck)
        self.disparity_branch = DisparityBranch(shape.neck.widths[2], shape.neck)
        self.head = AnchorHead(
            self.backbone.out_channels[2] + shape.neck.widths[2],
            preset.anchors.per_cell,
            len(preset.classes),
            shape.head,
        )

    def features(self, left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised RGB (B, 3, H, W) twice to head features and stereo features, both at stride 16."""
        both = self.backbone(torch.cat([left, right]))
        count = left.shape[0]
        left_features = tuple(level[:count] for level in both)
        right_features = tuple(level[count:] for level in both)
        stereo = self.neck(left_features, right_features)
        return torch.cat([left_features[2], stereo], dim=1), stereo

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Normalised RGB (B, 3, H, W) twice to cls_logits (B, N, classes + 1) and box_deltas (B, N, 12)."""
        features, _ = self.features(left, right)
        logits: torch.Tensor
        deltas: torch.Tensor
        logits, deltas = self.head(features)
        return logits, deltas

    def forward_training(
        self, left: torch.Tensor, right: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """As `forward`, and the disparity logits (B, disparity classes, H / 4, W / 4)."""
        features, stereo = self.features(left, right)
        logits, deltas = self.head(features)
        return logits, deltas, self.disparity_branch(stereo)
