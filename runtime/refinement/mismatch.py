"""How badly the samples of a box match in the right view, in NumPy; the oracle of `runtime.refinement.kernel`."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from runtime.contracts.geometry import FloatArray
from runtime.refinement.samples import BoxSamples, FloatImage, Patches

NO_MATCH: Final = 1e3
"""Value of the right view beyond its border."""


def mismatch(samples: BoxSamples, centers_px: FloatArray) -> FloatArray:
    """Cost of each disparity of the box's centre: 0 where both views are alike, 1 where nothing matches.

    The mean over the best patches of their mean saturated difference.

    Args:
        samples: of the box, R x C.
        centers_px: (K,) disparities.

    Returns:
        (K,) costs.
    """
    center_px = centers_px.astype(np.float32)[:, None, None]
    nearer = samples.behind_per_px * center_px  # behind the centre: so much smaller is the disparity there
    nearer += 1
    np.maximum(nearer, center_px / np.float32(samples.focal_baseline), out=nearer)  # no surface before a metre
    columns = samples.columns - np.divide(center_px, nearer, out=nearer)
    count, height, width = columns.shape
    rows = np.broadcast_to(samples.rows[:, None], (count, height, width)).reshape(count * height, width)
    differences: FloatImage = cv2.remap(
        samples.right,
        columns.reshape(count * height, width),
        rows,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=NO_MATCH,
    ).reshape(columns.shape)
    differences -= samples.wanted
    np.abs(differences, out=differences)
    differences /= np.float32(samples.saturation)
    np.minimum(differences, 1, out=differences)
    if not samples.seen.all():
        differences[:, ~samples.seen] = 0
    return _best_patches(differences, samples.patches)


def _best_patches(differences: FloatImage, patches: Patches) -> FloatArray:
    """(K,) mean over the best patches of (K, R, C) differences, 0 where a sample does not count."""
    bands = np.add.reduceat(differences, patches.row_starts, axis=1)
    sums: FloatArray = np.add.reduceat(bands, patches.column_starts, axis=2).astype(np.float64)
    full = patches.counts > 0
    means = sums[:, full] / patches.counts[full]
    best: FloatArray = np.partition(means, patches.trusted - 1, axis=1)[:, : patches.trusted].mean(axis=1)
    return best
