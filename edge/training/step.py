"""One optimisation step: forward, the three losses, backward, clipping, Adam (paper, section III-C)."""

from __future__ import annotations

import torch
from torch import nn

from edge.detector.presets import Preset
from edge.training.distributed import ALONE, Ranks, joint_sum, share_of_denominator, training_pass
from edge.training.losses import box_loss, class_loss, disparity_loss, valid_pixels
from edge.training.run_record import RunSettings
from edge.training.stream import Batch

SHARE_OFFSET = 1e-6  # of `box_loss`: keeps a batch without objects from dividing by zero


def set_modes(detector: nn.Module, *, freeze_norms: bool) -> None:
    """Training mode; the backbone's norms stay in evaluation mode (official behaviour), all of them on demand."""
    detector.train()
    detector.backbone.eval()  # type: ignore[union-attr, operator]
    if freeze_norms:
        for module in detector.modules():
            if isinstance(module, nn.modules.batchnorm._BatchNorm):
                module.eval()


def train_step(
    detector: nn.Module,
    preset: Preset,
    batch: Batch,
    *,
    optimiser: torch.optim.Optimizer,
    settings: RunSettings,
    forward: nn.Module | None = None,
    ranks: Ranks = ALONE,
) -> dict[str, float]:
    """One optimisation step.

    A batch in which nothing teaches (labelled, no objects, and a class loss that skips such images) changes nothing:
    its gradients are zero, and Adam's memory alone would move the weights.

    Args:
        detector: the network; its modes are set.
        preset: weights of the losses, clipping.
        batch: this process's share, on its device.
        optimiser: over the trained parameters.
        settings: precision and frozen norms.
        forward: of `training_pass`; needed with several processes.
        ranks: this process among them.

    Returns:
        Losses of the joint batch, and the norm of its gradient before clipping.
    """
    set_modes(detector, freeze_norms=settings.freeze_norms)
    device = batch.left.device
    network = training_pass(detector, ranks, device) if forward is None else forward
    with torch.autocast(device.type, dtype=torch.bfloat16, enabled=settings.mixed_precision):
        logits, deltas, disparity = network(batch.left, batch.right)
    logits, deltas = logits.float(), deltas.float()
    weights = logits.new_tensor(preset.training.class_weights)
    training = preset.training
    own = {
        "objects": SHARE_OFFSET + sum(float(target.object_count) for target in batch.targets),
        "unlabelled": float(batch.unlabelled),
    }
    if disparity is not None and batch.disparity is not None:
        own["matched"] = valid_pixels(batch.disparity, disparity.shape[1])
    joint = joint_sum(own, ranks, device)
    joint["objects"] -= (ranks.count - 1) * SHARE_OFFSET
    classes = class_loss(
        logits[..., :-1],
        batch.targets,
        weights,
        dead_zone=training.dead_zones,
        empty_images_teach=training.empty_images_teach,
    )
    if joint["unlabelled"]:  # they teach no class: the mean is over the others
        images = len(batch.targets) * ranks.count
        classes = classes * (images / max(images - joint["unlabelled"], 1.0))
    boxes = box_loss(logits[..., -1], deltas, batch.targets, z_weight=training.z_weight, dead_zone=training.dead_zones)
    if ranks.count > 1:
        boxes = boxes * share_of_denominator(own["objects"], joint["objects"], ranks)
    disparities = deltas.new_zeros(())
    if disparity is not None and batch.disparity is not None:
        disparities = disparity_loss(
            disparity.float(),
            batch.disparity,
            focal_coefficient=training.disparity_focal,
            valid_only=training.disparity_valid_only,
        )
        if training.disparity_valid_only and ranks.count > 1:
            disparities = disparities * share_of_denominator(own["matched"], max(joint["matched"], 1.0), ranks)
    elif disparity is not None and ranks.count > 1:
        disparities = 0.0 * disparity.float().sum()  # the other processes wait for each parameter's gradient
    losses = _joint_means(
        {"class_loss": classes, "box_loss": boxes, "disparity_loss": disparities}, ranks=ranks, device=device
    )
    total = classes + boxes
    # official: a batch without objects does not teach disparity; frames that are there to teach it always do
    teaches_disparity = losses["box_loss"] != 0 or joint["unlabelled"] > 0
    if teaches_disparity:
        total = total + training.disparity_weight * disparities
    elif ranks.count > 1:
        total = total + 0.0 * disparities  # as above
    optimiser.zero_grad(set_to_none=True)
    total.backward()
    if losses["class_loss"] == 0 and not teaches_disparity:
        optimiser.zero_grad(set_to_none=True)
        return losses | {"gradient_norm": 0.0}
    if not teaches_disparity and disparity is not None:
        for parameter in detector.disparity_branch.parameters():  # type: ignore[union-attr, operator]
            parameter.grad = None
    parameters = [p for group in optimiser.param_groups for p in group["params"]]
    norm = torch.nn.utils.clip_grad_norm_(parameters, training.gradient_clip_norm)
    optimiser.step()
    return losses | {"gradient_norm": float(norm)}


def _joint_means(losses: dict[str, torch.Tensor], *, ranks: Ranks, device: torch.device) -> dict[str, float]:
    means = {name: float(value.detach()) for name, value in losses.items()}
    return {name: value / ranks.count for name, value in joint_sum(means, ranks, device).items()}
