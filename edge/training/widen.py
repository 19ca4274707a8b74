"""Weights of a network with smaller kernels, as the start of one with larger ones."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import nn
from torch.nn import functional

from edge.detector.checkpoint_file import Checkpoint


def widened(checkpoint: Checkpoint, detector: nn.Module) -> tuple[Checkpoint, tuple[str, ...]]:
    """Weights whose smaller kernels stand in the middle of the detector's larger ones, zeros around them.

    Under padding that keeps an image's size, as in all of the detector's convolutions, it is the same function.

    Args:
        checkpoint: weights (M, C, k, ...) by name, k odd.
        detector: with kernels of (M, C, K, ...), K odd and not smaller; what else does not fit stays as it is.

    Returns:
        The weights, and the names of those that grew.
    """
    own = detector.state_dict()
    grown = {
        name: _in_the_middle(value, own[name].shape[2:])
        for name, value in checkpoint.state.items()
        if name in own and _fits_inside(value.shape, own[name].shape)
    }
    return replace(checkpoint, state=checkpoint.state | grown), tuple(grown)


def _fits_inside(small: torch.Size, large: torch.Size) -> bool:
    if len(small) != len(large) or len(small) < 3 or small[:2] != large[:2] or small == large:
        return False
    return all(k % 2 and K % 2 and k <= K for k, K in zip(small[2:], large[2:], strict=True))


def _in_the_middle(weight: torch.Tensor, size: torch.Size) -> torch.Tensor:
    margins = [(K - k) // 2 for k, K in zip(weight.shape[2:], size, strict=True)]
    return functional.pad(weight, [margin for margin in reversed(margins) for _ in range(2)])
