"""Disparity supervision from block matching, so that no lidar is needed (paper, section III-C)."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CELL_PX = 4
SUBPIXELS = 16  # StereoBM's fixed-point unit


def block_matching_disparity(
    left: NDArray[np.uint8], right: NDArray[np.uint8], *, disparities: int = 192, block: int = 25
) -> NDArray[np.float32]:
    """Disparity of a rectified pair on the stride-4 grid.

    Args:
        left, right: (H, W) uint8 grey images of the network's size.
        disparities: search range in pixels, a multiple of 16.
        block: window in pixels, odd.

    Returns:
        (H / 4, W / 4) float32 pixels of the network image: the maximum of each 4 x 4 cell, 0 where nothing matched.
    """
    matched = cv2.StereoBM.create(numDisparities=disparities, blockSize=block).compute(left, right)
    return reduce_to_cells(matched)


def reduce_to_cells(disparity_sixteenths: NDArray[np.int16]) -> NDArray[np.float32]:
    """The matcher's (H, W) int16 map to the stride-4 grid in pixels; negatives become 0."""
    valid = np.maximum(disparity_sixteenths, 0)
    height, width = valid.shape[0] // CELL_PX, valid.shape[1] // CELL_PX
    cells = valid[: height * CELL_PX, : width * CELL_PX].reshape(height, CELL_PX, width, CELL_PX)
    return cells.max(axis=(1, 3)).astype(np.float32) / np.float32(SUBPIXELS)
