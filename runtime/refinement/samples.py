"""The samples of one box: where both views are looked at, and which groups of them count."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Self

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray

FloatImage = NDArray[np.float32]

VEHICLE_SATURATION, PERSON_SATURATION = 0.7, 1.0
"""Normalised difference from which on a pixel counts as not matching at all."""
PATCH_ROWS, PATCH_COLUMNS = 3, 8
"""The samples of a vehicle are judged in so many patches; those of a person in one."""
TRUSTED_SHARE: Final = 0.8
"""Of the patches, those that match best count: hedges, poles and cars nobody found hide the others, or glass shows what
is behind."""
LEAST_PATCH_SHARE: Final = 0.3
"""Of the samples of the fullest patch; patches with fewer are passed over."""


@dataclass(frozen=True, slots=True)
class Patches:
    """Groups of neighbouring samples, of which the best count.

    Attributes:
        row_starts, column_starts: int64, where each group begins.
        counts: (row groups, column groups) float32 samples that count; 0 where a patch is passed over.
        trusted: how many patches count.
    """

    row_starts: NDArray[np.int64]
    column_starts: NDArray[np.int64]
    counts: FloatImage
    trusted: int

    @classmethod
    def of(cls, seen: NDArray[np.bool_], *, rows: int, columns: int) -> Self:
        """At most so many rows and columns of patches over (R, C) samples that count."""
        row_starts, column_starts = (
            np.unique(np.arange(most) * size // most) for size, most in zip(seen.shape, (rows, columns), strict=True)
        )
        bands = np.add.reduceat(seen.astype(np.float32), row_starts, axis=0)
        counts = np.add.reduceat(bands, column_starts, axis=1)
        counts[counts < LEAST_PATCH_SHARE * counts.max()] = 0
        return cls(row_starts, column_starts, counts, max(1, round(TRUSTED_SHARE * np.count_nonzero(counts))))


@dataclass(frozen=True, slots=True)
class BoxSamples:
    """One box: R rows and C columns of samples, dense arrays.

    Attributes:
        right: (H, W) normalised right view.
        rows: (R,) float32 of both views.
        columns: (C,) float32 of the right view at no disparity.
        behind_per_px: (R, C) float32 from the centre's depth to the surface's, metres over ``focal_baseline``.
        wanted: (R, C) float32 values of the normalised left view.
        seen: (R, C) samples that count, at least one.
        focal_baseline: pixels times metres.
        saturation: difference from which on a sample counts as not matching at all.
        patches: how samples are judged together.
    """

    right: FloatImage
    rows: NDArray[np.float32]
    columns: NDArray[np.float32]
    behind_per_px: FloatImage
    wanted: FloatImage
    seen: NDArray[np.bool_]
    focal_baseline: float
    saturation: float
    patches: Patches

    @classmethod
    def look(
        cls,
        left: FloatImage,
        right: FloatImage,
        columns: FloatArray,
        rows: FloatArray,
        seen: NDArray[np.bool_],
        behind_m: FloatArray,
        *,
        focal_baseline: float,
        offset_px: float,
        solid: bool,
    ) -> Self:
        """Samples the left view.

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
        across, down = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
        return cls(
            right=right,
            rows=rows.astype(np.float32),
            columns=(columns - offset_px).astype(np.float32),
            behind_per_px=(behind_m / focal_baseline).astype(np.float32),
            wanted=cv2.remap(left, across, down, cv2.INTER_LINEAR),
            seen=seen,
            focal_baseline=focal_baseline,
            saturation=VEHICLE_SATURATION if solid else PERSON_SATURATION,
            patches=Patches.of(seen, rows=PATCH_ROWS if solid else 1, columns=PATCH_COLUMNS if solid else 1),
        )
