"""Puts the normalisation of camera pixels into the graph."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

WRAPPER_PREFIX = "network."
"""What the wrapper puts before the names of the wrapped network's modules."""


class FromPixels(nn.Module):
    """A network that takes RGB pixels as uint8 where the one inside takes them normalised.

    ``x = (value / 255 - mean) / std`` for each channel, written as one product and one sum.
    """

    def __init__(
        self, network: nn.Module, *, mean: tuple[float, float, float], std: tuple[float, float, float]
    ) -> None:
        """Wraps a network.

        Args:
            network: Takes one or two views, float32 [B, 3, H, W], normalised.
            mean: Of R, G, B on a scale of 0 to 1.
            std: Likewise.
        """
        super().__init__()
        self.network = network
        std_tensor = torch.tensor(std, dtype=torch.float64).reshape(1, 3, 1, 1)
        mean_tensor = torch.tensor(mean, dtype=torch.float64).reshape(1, 3, 1, 1)
        self.register_buffer("scale", (1 / (255 * std_tensor)).float())
        self.register_buffer("offset", (-mean_tensor / std_tensor).float())

    def forward(self, *views: Tensor) -> tuple[Tensor, ...]:
        """uint8 views [B, 3, H, W] to what the network gives."""
        scale, offset = cast(Tensor, self.scale), cast(Tensor, self.offset)
        outputs: tuple[Tensor, ...] = self.network(*(view.float() * scale + offset for view in views))
        return outputs
