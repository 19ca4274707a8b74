"""The depth at which the samples of a box match best in the other view."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray
from runtime.refinement.evidence import UNSEARCHED, match_evidence
from runtime.refinement.mismatch import mismatch
from runtime.refinement.samples import BoxSamples, FloatImage

Pixels = NDArray[np.uint8]

SMOOTHING_PX: Final = 1.0
"""Deviation of the Gaussian that takes sensor noise and lookup error out before anything is compared."""
WINDOW_PX: Final = 11
"""Side of the square over which brightness and contrast are normalised."""
CONTRAST_FLOOR: Final = 2.0
"""Grey levels added to the local contrast: flat walls stay flat."""
RANGE_PX: Final = 4.0
RANGE_SHARE: Final = 0.06
"""Half the search, camera pixels of disparity: so many, and so large a share of the network's disparity."""
COARSE_STEPS, FINE_STEPS = 33, 9
PRIOR_PER_PX2: Final = 0.02
PRIOR_LIMIT_PX2: Final = 2.0
"""Cost of leaving the network's disparity, a squared pixel, and from where on it grows no more: the network errs by a
fraction of a pixel or is lost. A perfect mismatch of the pixels costs 1."""
LEAST_DISPARITY_PX: Final = 2.0
"""Depths of less are not refined: 190 m with KITTI's rig, 30 m with a baseline of 7.5 cm."""


def normalised(image: Pixels) -> FloatImage:
    """(H, W) grey with local mean 0 and local contrast near 1, of (H, W, 3) uint8 BGR."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), SMOOTHING_PX)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.blur(grey, window)
    contrast = np.sqrt(np.maximum(cv2.blur(grey * grey, window) - mean * mean, 0.0)) + CONTRAST_FLOOR
    result: FloatImage = ((grey - mean) / contrast).astype(np.float32, copy=False)
    return result


def best_depth(samples: BoxSamples, depth_m: float) -> tuple[float, Sequence[float]]:
    """Depth of the box's centre, metres, at which its samples match best; starts from the network's.

    The search looks as far to either side; up to the least disparity it narrows to nothing.

    Args:
        samples: of the box.
        depth_m: the network's.

    Returns:
        The depth, and what `match_evidence` says of it.
    """
    start_px = samples.focal_baseline / depth_m
    reach_px = min(RANGE_PX + RANGE_SHARE * start_px, start_px - LEAST_DISPARITY_PX)
    if reach_px <= 0:
        return depth_m, UNSEARCHED[:-1]
    moves = np.linspace(-reach_px, reach_px, COARSE_STEPS)
    step = moves[1] - moves[0]
    coarse = mismatch(samples, start_px + moves)
    middle = moves[int(np.argmin(coarse + _prior(moves)))]
    fine = np.linspace(middle - step, middle + step, FINE_STEPS)
    costs = mismatch(samples, start_px + fine) + _prior(fine)
    lowest = int(np.argmin(costs))
    move = float(fine[lowest])
    if 0 < lowest < len(fine) - 1:
        before, here, after = costs[lowest - 1 : lowest + 2]
        move += 0.5 * float(fine[1] - fine[0]) * float((before - after) / (before - 2 * here + after + 1e-9))
    return samples.focal_baseline / (start_px + move), match_evidence(moves, coarse, start_px=start_px, move=move)


def _prior(moves: FloatArray) -> FloatArray:
    return PRIOR_PER_PX2 * np.minimum(moves**2, PRIOR_LIMIT_PX2)
