"""Disparity supervision: block matching of the pair, so that no lidar is needed (paper, section III-C1), or points.

All maps are on the stride-4 grid in pixels of the network image; 0 is unknown. Disparities pass through the matcher's
sixteenths of a pixel, as the official code stores them.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, StereoGeometry, project_to_image
from runtime.contracts.manifest import Normalisation

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


def grey_of(image_bgr: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Luminance (H, W) uint8 of a BGR image."""
    grey: NDArray[np.uint8] = cv2.cvtColor(image_bgr, cv2.COLOR_BGR2GRAY)
    return grey


def official_grey(image_bgr: NDArray[np.generic], normalisation: Normalisation) -> NDArray[np.uint8]:
    """What the official code matches: the weights of red and blue exchanged, pixels cut to bytes after a detour.

    The detour through the normalised image (float32 there, float64 back) takes one step off a tenth of the pixels.

    Args:
        image_bgr: (H, W, 3) in 0..255, resized as float.
        normalisation: of the preset.
    """
    rgb = image_bgr[..., ::-1].astype(np.float32) / np.float32(255)
    normal = (rgb - np.array(normalisation.mean, np.float32)) / np.array(normalisation.std, np.float32)
    back = (normal * np.array(normalisation.std) + np.array(normalisation.mean)) * 255
    grey: NDArray[np.uint8] = cv2.cvtColor(back.astype(np.uint8), cv2.COLOR_BGR2GRAY)  # of an RGB image: the exchange
    return grey


def disparity_from_points(points_in_camera: FloatArray, geometry: StereoGeometry) -> NDArray[np.int16]:
    """Disparity of points that the left camera sees, at their pixels; the nearest wins.

    ``disparity = f b / Z`` with f b the difference of the two cameras' translation columns, as the official code has
    it, and between cameras of other principal columns their difference more; rounded down to sixteenths.

    Args:
        points_in_camera: (N, 3) metres in the labels' camera.
        geometry: of the network image.

    Returns:
        (H, W) int16 sixteenths of a pixel, 0 where no point lies.
    """
    width, height = geometry.image_size_wh
    pixels, depth_m = project_to_image(geometry.P2, points_in_camera)
    column, row = np.floor(pixels).T
    seen = (depth_m > 0) & (points_in_camera[:, 2] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    focal_baseline = geometry.P2[0, 3] - geometry.P3[0, 3]
    disparity_px = focal_baseline / points_in_camera[seen, 2] + geometry.P2[0, 2] - geometry.P3[0, 2]
    sixteenths = np.minimum(SUBPIXELS * disparity_px, np.iinfo(np.int16).max)
    found = np.zeros((height, width), np.int16)
    np.maximum.at(found, (row[seen].astype(int), column[seen].astype(int)), sixteenths.astype(np.int16))
    return found


def reduce_to_cells(disparity_sixteenths: NDArray[np.int16]) -> NDArray[np.float32]:
    """The matcher's (H, W) int16 map to the stride-4 grid in pixels; negatives become 0."""
    valid = np.maximum(disparity_sixteenths, 0)
    height, width = valid.shape[0] // CELL_PX, valid.shape[1] // CELL_PX
    cells = valid[: height * CELL_PX, : width * CELL_PX].reshape(height, CELL_PX, width, CELL_PX)
    return cells.max(axis=(1, 3)).astype(np.float32) / np.float32(SUBPIXELS)
