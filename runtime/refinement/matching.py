"""How badly the samples of a box match in the other view, and the depth at which they match best."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray

Pixels = NDArray[np.uint8]
FloatImage = NDArray[np.float32]

SMOOTHING_PX: Final = 1.0
"""Deviation of the Gaussian that takes sensor noise and lookup error out before anything is compared."""
WINDOW_PX: Final = 11
"""Side of the square over which brightness and contrast are normalised."""
CONTRAST_FLOOR: Final = 2.0
"""Grey levels added to the local contrast: flat walls stay flat."""
VEHICLE_SATURATION, PERSON_SATURATION = 0.7, 1.0
"""Normalised difference from which on a pixel counts as not matching at all."""
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
PATCH_ROWS, PATCH_COLUMNS = 3, 8
"""The samples of a vehicle are judged in so many patches."""
TRUSTED_SHARE: Final = 0.8
"""Of the patches, those that match best count: hedges, poles and cars nobody found hide the others, or glass shows what
is behind."""
LEAST_PATCH_SHARE: Final = 0.3
"""Of the samples of the fullest patch; patches with fewer are passed over."""
_NO_MATCH: Final = 1e3


def normalised(image: Pixels) -> FloatImage:
    """(H, W) grey with local mean 0 and local contrast near 1, of (H, W, 3) uint8 BGR."""
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32), (0, 0), SMOOTHING_PX)
    window = (WINDOW_PX, WINDOW_PX)
    mean = cv2.blur(grey, window)
    contrast = np.sqrt(np.maximum(cv2.blur(grey * grey, window) - mean * mean, 0.0)) + CONTRAST_FLOOR
    result: FloatImage = ((grey - mean) / contrast).astype(np.float32, copy=False)
    return result


class Matching:
    """Samples of one box, and how badly they match at a depth.

    Args:
        left, right: normalised views.
        columns: (C,) of the left view.
        rows: (R,) of both views.
        seen: (R, C) samples that count, at least one.
        behind_m: (R, C) metres from the centre's depth to the surface's.
        focal_baseline: pixels times metres.
        offset_px: how much larger all disparities are than the depths say.
        solid: judged by the patches that match best, as vehicles are; else by all samples.
    """

    def __init__(
        self,
        left: FloatImage,
        right: FloatImage,
        columns: FloatArray,
        rows: FloatArray,
        seen: NDArray[np.bool_],
        behind_m: FloatArray,
        focal_baseline: float,
        offset_px: float,
        *,
        solid: bool,
    ) -> None:
        self._right, self._seen, self._focal_baseline = right, seen, focal_baseline
        self._columns = (columns - offset_px).astype(np.float32)
        self._behind_per_px = (behind_m / focal_baseline).astype(np.float32)
        across, down = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        self._rows = np.tile(down, (COARSE_STEPS, 1))
        self._wanted = cv2.remap(left, across, down, cv2.INTER_LINEAR)
        self._patches = _Patches(seen) if solid else None
        self._saturation = np.float32(VEHICLE_SATURATION if solid else PERSON_SATURATION)

    def best_depth(self, depth_m: float) -> float:
        """Depth of the centre, metres, at which the samples match best; starts from the network's.

        The search looks as far to either side; up to the least disparity it narrows to nothing.
        """
        start_px = self._focal_baseline / depth_m
        reach_px = min(RANGE_PX + RANGE_SHARE * start_px, start_px - LEAST_DISPARITY_PX)
        if reach_px <= 0:
            return depth_m
        moves = np.linspace(-reach_px, reach_px, COARSE_STEPS)
        step = moves[1] - moves[0]
        middle = moves[int(np.argmin(self._costs(start_px, moves)))]
        fine = np.linspace(middle - step, middle + step, FINE_STEPS)
        costs = self._costs(start_px, fine)
        lowest = int(np.argmin(costs))
        move = float(fine[lowest])
        if 0 < lowest < len(fine) - 1:
            before, here, after = costs[lowest - 1 : lowest + 2]
            move += 0.5 * float(fine[1] - fine[0]) * float((before - after) / (before - 2 * here + after + 1e-9))
        return self._focal_baseline / (start_px + move)

    def _costs(self, start_px: float, moves: FloatArray) -> FloatArray:
        """(K,) mean saturated difference of the views, plus the prior, when the centre's disparity moves."""
        center_px = (start_px + moves).astype(np.float32)[:, None, None]
        nearer = self._behind_per_px * center_px  # behind the centre: so much smaller is the disparity there
        nearer += 1
        np.maximum(nearer, center_px / np.float32(self._focal_baseline), out=nearer)  # no surface before a metre
        columns = self._columns - np.divide(center_px, nearer, out=nearer)
        count, height, width = columns.shape
        differences: FloatImage = cv2.remap(
            self._right,
            columns.reshape(count * height, width),
            self._rows[: count * height],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=_NO_MATCH,
        ).reshape(columns.shape)
        differences -= self._wanted
        np.abs(differences, out=differences)
        differences /= self._saturation
        np.minimum(differences, 1, out=differences)
        if self._patches is None:
            costs: FloatArray = differences[:, self._seen].mean(axis=1, dtype=np.float64)
        else:
            costs = self._patches.cost(differences)
        costs += PRIOR_PER_PX2 * np.minimum(moves**2, PRIOR_LIMIT_PX2)
        return costs


class _Patches:
    """Groups of neighbouring samples, of which the best count."""

    def __init__(self, seen: NDArray[np.bool_]) -> None:
        self._hidden = None if seen.all() else ~seen
        self._starts = [
            np.unique(np.arange(most) * size // most)
            for size, most in zip(seen.shape, (PATCH_ROWS, PATCH_COLUMNS), strict=True)
        ]
        counts = self._sums(seen[None].astype(np.float32))[0]
        self._full = counts >= LEAST_PATCH_SHARE * counts.max()
        self._counts = counts[self._full]
        self._trusted = max(1, round(TRUSTED_SHARE * len(self._counts)))

    def cost(self, differences: FloatImage) -> FloatArray:
        """(K,) mean over the best patches of (K, R, C) differences, which are written over."""
        if self._hidden is not None:
            differences[:, self._hidden] = 0
        means = self._sums(differences)[:, self._full] / self._counts
        best: FloatArray = np.partition(means, self._trusted - 1, axis=1)[:, : self._trusted].mean(axis=1)
        return best

    def _sums(self, values: FloatImage) -> FloatArray:
        """(K, patches) sums over (K, R, C)."""
        bands = np.add.reduceat(values, self._starts[0], axis=1)
        sums: FloatArray = np.add.reduceat(bands, self._starts[1], axis=2).astype(np.float64)
        return sums.reshape(len(values), -1)
