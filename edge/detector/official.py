"""Names of the official code's checkpoints, and ours (github Owen-Liuyuxuan/visualDet3D), both ways."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import torch

OFFICIAL_PREFIX = "bbox_head."
_WEIGHT_ENDINGS = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
_REASONING = "core.neck.depth_reasoning."
_PREFIXES = (  # official, ours; a longer one before those that it begins with
    ("core.backbone.", "backbone."),
    ("core.neck.cost_volume_2.down_sample.", "neck.concat_volume.reduce."),
    ("core.neck.cost_volume_2.", "neck.concat_volume."),
    (f"{_REASONING}four_to_eight.0.", "neck.four_to_eight.ghost."),
    (f"{_REASONING}four_to_eight.2.", "neck.four_to_eight.block."),
    (f"{_REASONING}eight_to_sixteen.0.", "neck.eight_to_sixteen.ghost."),
    (f"{_REASONING}eight_to_sixteen.2.", "neck.eight_to_sixteen.block."),
    (f"{_REASONING}depth_reason.0.", "neck.sixteen.ghost."),
    (f"{_REASONING}depth_reason.1.", "neck.sixteen.block."),
    (f"{_REASONING}depth_output.", "disparity_branch.layers."),
    ("bbox_head.cls_feature_extraction.", "head.classification."),
    ("bbox_head.reg_feature_extraction.0.sequence.0.", "head.regression.0.0."),
    ("bbox_head.reg_feature_extraction.0.sequence.1.", "head.regression.0.1."),
    ("bbox_head.reg_feature_extraction.", "head.regression."),
)
_INNER = (
    (".primary_conv.1.", ".primary.0."),
    (".primary_conv.2.", ".primary.1."),
    (".cheap_operation.", ".cheap."),
)


def is_official(names: Iterable[str]) -> bool:
    """Whether the names are those of an official checkpoint."""
    return any(name.startswith(("core.", OFFICIAL_PREFIX)) for name in names)


def is_weight(official: str) -> bool:
    """Whether an official name is a layer's weight or statistic.

    The rest are buffers of losses (``bbox_head.regression_weight``) and of anchors: constants that the preset has.
    """
    return official.rpartition(".")[2] in _WEIGHT_ENDINGS and not official.startswith("bbox_head.anchors.")


def our_name(official: str) -> str:
    """An official name as it is called here; one that is not known stays as it is."""
    for theirs, ours in _PREFIXES:
        if official.startswith(theirs):
            name = ours + official[len(theirs) :]
            break
    else:
        return official
    for theirs, ours in _INNER:
        name = name.replace(theirs, ours)
    return name


def official_name(ours: str) -> str:
    """The inverse of `our_name`."""
    name = ours
    if ".ghost." in name:
        for theirs, mine in _INNER:
            name = name.replace(mine, theirs)
    for theirs, mine in _PREFIXES:
        if name.startswith(mine):
            return theirs + name[len(mine) :]
    return ours


def from_official(state: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """An official state dict under our names; buffers that are no weights are left out."""
    return {our_name(name): value for name, value in state.items() if is_weight(name)}
