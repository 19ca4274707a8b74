"""Do two models find the same boxes? Needs no labels.

Detections of one class are paired one to one: the first model's, by falling score, each take the free
detection of the second that overlaps theirs most in the image, if by at least one half.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.evaluation.tables import image_overlap
from runtime.contracts.errors import FormatError
from runtime.contracts.measurement import NEAR_BAND, NEAR_M, Agreement
from runtime.contracts.objects import Detections3D, FloatArray, IntArray, Objects3D

MIN_IMAGE_OVERLAP = 0.5
BAND_EDGES_M = (0.0, 15.0, 30.0, 45.0, np.inf)
BAND_NAMES = ("0-15", "15-30", "30-45", "45+")
ALL_BANDS = "all"


@dataclass(frozen=True, slots=True)
class Pairing:
    """Which rows of two records of one frame belong together.

    Attributes:
        first, second: (M,) rows of the pairs.
        only_first, only_second: rows without a partner.
    """

    first: IntArray
    second: IntArray
    only_first: IntArray
    only_second: IntArray


def pair_up(first: Detections3D, second: Detections3D | Objects3D) -> Pairing:
    """Pair the boxes of one frame: same class, one to one, greedy by the first's score, enough overlap."""
    free = np.ones(len(second), dtype=bool)
    rows: list[tuple[int, int]] = []
    if len(first) and len(second):
        left, right = np.divmod(np.arange(len(first) * len(second)), len(second))
        overlap = image_overlap(first.box_in_left_image[left], second.box_in_left_image[right])
        same = _names(first)[left] == _names(second)[right]
        table = np.where(same, overlap, 0.0).reshape(len(first), len(second))
        for row in range(len(first)):  # records are sorted by falling score
            candidates = np.where(free, table[row], 0.0)
            best = int(np.argmax(candidates))
            if candidates[best] >= MIN_IMAGE_OVERLAP:
                free[best] = False
                rows.append((row, best))
    pairs = np.array(rows, dtype=np.int64).reshape(-1, 2)
    return Pairing(
        first=pairs[:, 0],
        second=pairs[:, 1],
        only_first=np.setdiff1d(np.arange(len(first)), pairs[:, 0]),
        only_second=np.flatnonzero(free),
    )


def _names(record: Detections3D | Objects3D) -> np.ndarray:
    return np.array(record.class_names)[record.class_id]


def agreement(
    reference: Sequence[Detections3D],
    other: Sequence[Detections3D],
    *,
    reference_score: float,
    other_score: float,
) -> Agreement:
    """How far two models agree over the same frames.

    Args:
        reference, other: one record a frame, in the same order.
        reference_score, other_score: display threshold of each model.

    Raises:
        FormatError: the two lists differ in length.
    """
    if len(reference) != len(other):
        raise FormatError(
            f"the models ran on {len(reference)} and {len(other)} frames, expected the same; run both on one source"
        )
    counts = np.zeros(3, dtype=np.int64)
    distances, errors = [np.zeros(0)], [np.zeros(0)]
    for left, right in zip(reference, other, strict=True):
        left, right = left.above(reference_score), right.above(other_score)
        pairs = pair_up(left, right)
        counts += (len(left), len(right), len(pairs.first))
        centers = left.center_in_camera[pairs.first]
        distances.append(np.linalg.norm(centers, axis=1))
        errors.append(np.linalg.norm(centers - right.center_in_camera[pairs.second], axis=1))
    found = int(counts[0] + counts[1])
    return Agreement(
        matched_share=2.0 * int(counts[2]) / found if found else 1.0,
        reference_count=int(counts[0]),
        other_count=int(counts[1]),
        matched_count=int(counts[2]),
        centre_error_m={
            band: (float(np.median(values)), float(np.mean(values)))
            for band, values in by_band(np.concatenate(distances), np.concatenate(errors)).items()
        },
    )


def by_band(distance_m: FloatArray, values: FloatArray) -> dict[str, FloatArray]:
    """Values by distance band, `ALL_BANDS` and `NEAR_BAND` first; bands without a value are left out."""
    bands = {ALL_BANDS: values, NEAR_BAND: values[distance_m < NEAR_M]}
    index = np.searchsorted(BAND_EDGES_M, distance_m, side="right") - 1
    for number, name in enumerate(BAND_NAMES):
        bands[name] = values[index == number]
    return {name: part for name, part in bands.items() if part.size}
