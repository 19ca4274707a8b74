"""Are left and right the right way round? Decided by looking: what is near lies further left in the right view."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

BLOCK_HW = (32, 64)
REACH_PX = 48
MIN_CONTRAST = 8.0
"""Deviation of a block's levels below which there is nothing to match."""
MIN_CORRELATION = 0.85
MIN_SHIFT_PX = 2
MIN_BLOCKS = 12
MIN_MAJORITY = 0.8
"""Share of the telling blocks that must agree."""


@dataclass(frozen=True, slots=True)
class ViewOrder:
    """Blocks of the left view whose like was found in the right one.

    Attributes:
        further_left: found further left, by a disparity above 0, as it must be; further_right: the other way.
    """

    further_left: int = 0
    further_right: int = 0

    def __add__(self, other: ViewOrder) -> ViewOrder:
        return ViewOrder(self.further_left + other.further_left, self.further_right + other.further_right)

    @property
    def right_way_round(self) -> bool | None:
        """Whether the views are as they should be; None where the pictures do not tell."""
        total = self.further_left + self.further_right
        if total < MIN_BLOCKS or max(self.further_left, self.further_right) < MIN_MAJORITY * total:
            return None
        return self.further_left > self.further_right


def view_order(left: NDArray[np.float64], right: NDArray[np.float64]) -> ViewOrder:
    """Look for each block of the left view in the same rows of the right one.

    Args:
        left, right: (3, H, W) levels.
    """
    grey = [np.ascontiguousarray(view.mean(axis=0), dtype=np.float32) for view in (left, right)]
    height, width = grey[0].shape
    counts = [0, 0]
    for top in range(0, height - BLOCK_HW[0] + 1, BLOCK_HW[0]):
        rows = slice(top, top + BLOCK_HW[0])
        for start in range(REACH_PX, width - BLOCK_HW[1] - REACH_PX + 1, BLOCK_HW[1]):
            block = grey[0][rows, start : start + BLOCK_HW[1]]
            if block.std() < MIN_CONTRAST:
                continue
            strip = grey[1][rows, start - REACH_PX : start + BLOCK_HW[1] + REACH_PX]
            score = cv2.matchTemplate(strip, block, cv2.TM_CCOEFF_NORMED)[0]
            disparity_px = REACH_PX - int(np.argmax(score))
            if float(score.max()) >= MIN_CORRELATION and abs(disparity_px) >= MIN_SHIFT_PX:
                counts[disparity_px < 0] += 1
    return ViewOrder(*counts)
