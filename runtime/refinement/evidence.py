"""What refinement learns of each box beside its depth: how far the match can be believed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray
from runtime.contracts.objects import Detections3D

EVIDENCE: Final = ("cost", "gain", "margin", "shift", "sharpness", "hidden")
"""Columns: cost of the best match (0 alike, 1 nothing matches); how much better it is than the network's own depth; how
much worse the best match elsewhere is; how far the disparity moved, pixels over the root of the disparity; how much
worse a pixel more or less is; share of the samples that nearer boxes hide."""
UNSEARCHED: Final = (0.5, 0.0, 0.0, 0.0, 0.0, 0.0)
"""Of a box that keeps the network's depth."""
ELSEWHERE_PX: Final = 1.5
"""From here on another depth is another match."""
MOST_DIFFERENCE: Final = 0.3
"""Of costs: beyond, a match is as good as certain."""
MOST_SHIFT_PX: Final = 6.0


@dataclass(frozen=True, slots=True)
class Refined:
    """Boxes with refined depths.

    Attributes:
        detections: N boxes, in the order that they came in.
        evidence: (N, 6) float64, columns of `EVIDENCE`.
    """

    detections: Detections3D
    evidence: NDArray[np.float64]


def match_evidence(moves: FloatArray, costs: FloatArray, *, start_px: float, move: float) -> Sequence[float]:
    """The columns of `EVIDENCE` that one search tells, all but the last.

    Args:
        moves: (K,) rising moves of the disparity that were tried, pixels.
        costs: (K,) how badly the samples matched there.
        start_px: the network's disparity.
        move: the one that was chosen.
    """
    cost, own, less, more = np.interp([move, 0.0, move - 1.0, move + 1.0], moves, costs)
    elsewhere = np.abs(moves - move) > ELSEWHERE_PX
    rival = costs[elsewhere].min() if elsewhere.any() else 1.0
    shift = min(abs(move), MOST_SHIFT_PX) / np.sqrt(max(start_px, 1.0))
    sharpness = min(0.5 * (less + more) - cost, MOST_DIFFERENCE)
    return float(cost), float(own - cost), float(min(rival - cost, MOST_DIFFERENCE)), float(shift), float(sharpness)
