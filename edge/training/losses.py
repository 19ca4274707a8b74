"""The three losses (paper, section III-C2): focal for classes, smooth L1 for boxes, stereo focal for disparity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F

from edge.training.assign import BACKGROUND

FOCAL_GAMMA = 2.0
CLASS_DEAD_ZONE = 1e-5  # official: smaller element losses count as zero
SMOOTH_L1_KNEE = 0.04
BOX_DEAD_ZONE = 0.01  # official: smaller differences count as zero
DISPARITY_SPREAD = 0.5
# x y w h cx cy | z | sin cos | w h l | facing
BOX_TERM_WEIGHTS = (1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 12.0, 1.0, 1.0, 0.5, 0.5, 0.5, 1.0)
Z_TERM = 6


@dataclass(frozen=True, slots=True)
class ImageTargets:
    """`edge.training.assign.AnchorTargets` as tensors on the training device."""

    label: torch.Tensor
    positive: torch.Tensor
    deltas: torch.Tensor
    facing: torch.Tensor
    object_count: int


def focal_terms(
    logits: torch.Tensor, target: torch.Tensor, positive_weight: torch.Tensor, *, dead_zone: bool = True
) -> torch.Tensor:
    """Focal loss of each element, gamma 2, the class weight on the positive term only.

    Args:
        logits: (..., classes).
        target: same shape, 1 positive, 0 negative.
        positive_weight: (classes,).
        dead_zone: terms below 1e-5 count as zero.
    """
    log_p, log_not_p = F.logsigmoid(logits), F.logsigmoid(-logits)
    p = log_p.exp()
    loss = -target * positive_weight * (1 - p) ** FOCAL_GAMMA * log_p - (1 - target) * p**FOCAL_GAMMA * log_not_p
    return torch.where(loss < CLASS_DEAD_ZONE, torch.zeros_like(loss), loss) if dead_zone else loss


def smooth_l1_terms(difference: torch.Tensor, *, dead_zone: bool = True) -> torch.Tensor:
    """12.5 d^2 up to 0.04, then |d| - 0.02; with the dead zone, zero within 0.01."""
    d = difference.abs()
    loss = torch.where(d <= SMOOTH_L1_KNEE, 0.5 * d * d / SMOOTH_L1_KNEE, d - 0.5 * SMOOTH_L1_KNEE)
    return torch.where(d <= BOX_DEAD_ZONE, torch.zeros_like(loss), loss) if dead_zone else loss


def class_loss(
    logits: torch.Tensor,
    targets: list[ImageTargets],
    class_weights: torch.Tensor,
    *,
    dead_zone: bool = True,
    empty_images_teach: bool = False,
) -> torch.Tensor:
    """Mean over images of (sum of focal terms / labelled anchors).

    Args:
        logits: (B, N, classes), without the facing logit.
        targets: one an image.
        class_weights: (classes,).
        dead_zone: of `focal_terms`.
        empty_images_teach: an image without objects teaches background; else it counts as zero (official).
    """
    losses = []
    for image_logits, target in zip(logits, targets, strict=True):
        if target.object_count == 0 and not empty_images_teach:
            losses.append(image_logits.sum() * 0)
            continue
        taught = target.label >= BACKGROUND
        one_hot = F.one_hot(target.label[taught].long(), len(class_weights) + 1)[:, 1:].to(image_logits.dtype)
        terms = focal_terms(image_logits[taught], one_hot, class_weights, dead_zone=dead_zone)
        losses.append(terms.sum() / taught.sum().clamp(min=1))
    return torch.stack(losses).mean()


def box_loss(
    facing_logits: torch.Tensor,
    deltas: torch.Tensor,
    targets: list[ImageTargets],
    *,
    z_weight: float = 12.0,
    dead_zone: bool = True,
) -> torch.Tensor:
    """Weighted smooth L1 of the 12 numbers and cross-entropy of the facing logit.

    Mean over positives within an image; images weigh by their number of objects; then the mean of the 13 terms.

    Args:
        facing_logits: (B, N).
        deltas: (B, N, 12).
        targets: one an image.
        z_weight: weight of the depth term.
        dead_zone: of `smooth_l1_terms`.
    """
    weights = list(BOX_TERM_WEIGHTS)
    weights[Z_TERM] = z_weight
    term_weights = deltas.new_tensor(weights)
    image_terms, counts = [], []
    for image_facing, image_deltas, target in zip(facing_logits, deltas, targets, strict=True):
        if len(target.positive) == 0:
            image_terms.append(image_deltas.sum() * 0 + torch.zeros_like(term_weights))
        else:
            numbers = smooth_l1_terms(image_deltas[target.positive] - target.deltas, dead_zone=dead_zone)
            facing = F.binary_cross_entropy_with_logits(image_facing[target.positive], target.facing, reduction="none")
            image_terms.append((torch.cat([numbers, facing[:, None]], dim=1) * term_weights).mean(dim=0))
        counts.append(float(target.object_count))
    share = deltas.new_tensor(counts)
    share = share / (share.sum() + 1e-6)
    return (torch.stack(image_terms) * share[:, None]).sum(dim=0).mean()


def disparity_loss(
    logits: torch.Tensor, disparity: torch.Tensor, *, focal_coefficient: float = 0.0, valid_only: bool = False
) -> torch.Tensor:
    """Stereo focal loss: cross-entropy with softmax(-|d - truth| / 0.5) over the disparity classes.

    The official code's form is the default (coefficient 0, mean over all pixels); the paper's has coefficient 5 and
    the mean over valid pixels.

    Args:
        logits: (B, D, h, w).
        disparity: (B, h, w) in pixels of the network image; valid where 0 < value < D.
        focal_coefficient: exponent of (1 - target)^-c.
        valid_only: average over valid pixels only.
    """
    classes = torch.arange(logits.shape[1], device=logits.device, dtype=logits.dtype)[None, :, None, None]
    truth = disparity[:, None]
    valid = (truth > 0) & (truth < logits.shape[1])
    within = valid & (truth < logits.shape[1] - 1)
    target = F.softmax(-(classes - truth).abs() / DISPARITY_SPREAD, dim=1) * within
    weight = (1 - target) ** -focal_coefficient if focal_coefficient else 1.0
    per_pixel = -(target * weight * F.log_softmax(logits, dim=1)).sum(dim=1) * valid[:, 0]
    return per_pixel.sum() / valid.sum().clamp(min=1) if valid_only else per_pixel.mean()


def valid_pixels(disparity: torch.Tensor, classes: int) -> float:
    """Pixels that the stereo focal loss counts as matched."""
    return float(((disparity > 0) & (disparity < classes)).sum())
