"""Names of the official code's checkpoints, and ours (github Owen-Liuyuxuan/visualDet3D)."""

from __future__ import annotations

import re
from collections.abc import Mapping

import torch

OFFICIAL_PREFIX = "bbox_head."
_IGNORED = re.compile(r"bbox_head\.(balance_weights|regression_weight|loss_cls\.balance_weights)$")
_RENAMES = tuple(
    (re.compile(pattern), name)
    for pattern, name in (
        (r"^core\.backbone\.", "backbone."),
        (r"^core\.neck\.cost_volume_2\.down_sample\.", "neck.concat_volume.reduce."),
        (r"^core\.neck\.cost_volume_2\.", "neck.concat_volume."),
        (r"^core\.neck\.depth_reasoning\.(four_to_eight|eight_to_sixteen)\.0\.", r"neck.\1.ghost."),
        (r"^core\.neck\.depth_reasoning\.(four_to_eight|eight_to_sixteen)\.2\.", r"neck.\1.block."),
        (r"^core\.neck\.depth_reasoning\.depth_reason\.0\.", "neck.sixteen.ghost."),
        (r"^core\.neck\.depth_reasoning\.depth_reason\.1\.", "neck.sixteen.block."),
        (r"^core\.neck\.depth_reasoning\.depth_output\.", "disparity_branch.layers."),
        (r"^bbox_head\.cls_feature_extraction\.", "head.classification."),
        (r"^bbox_head\.reg_feature_extraction\.0\.sequence\.", "head.regression.0."),
        (r"^bbox_head\.reg_feature_extraction\.", "head.regression."),
        (r"\.primary_conv\.1\.", ".primary.0."),
        (r"\.primary_conv\.2\.", ".primary.1."),
        (r"\.cheap_operation\.", ".cheap."),
    )
)


def is_official(names: Mapping[str, object]) -> bool:
    """Whether the names are those of an official checkpoint."""
    return any(name.startswith(("core.", OFFICIAL_PREFIX)) for name in names)


def from_official(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """An official state dict under our names; the loss weights kept as buffers there are left out."""
    renamed = {}
    for name, value in state.items():
        if _IGNORED.search(name):
            continue
        for pattern, replacement in _RENAMES:
            name = pattern.sub(replacement, name)
        renamed[name] = value
    return renamed
