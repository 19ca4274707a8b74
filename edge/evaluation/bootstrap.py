"""How sure a figure is: paired bootstrap, frames drawn with replacement, the same draws for both models.

A draw is a weight a frame; matches are kept as events, so that a draw costs sums, not matching. Frames of one
drive resemble each other, so the intervals are too narrow where few drives are behind many frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from edge.evaluation.average_precision import AveragePrecision
from edge.evaluation.kitti_ap import ApTree, CurveKey, Evaluation, tree_of
from runtime.contracts.errors import FormatError
from runtime.contracts.objects import FloatArray, IntArray

DRAWS = 1000
SEED = 20240229
PERCENTILES = (2.5, 97.5)
_VALUES = ("r40", "r11", "orientation_r40", "orientation_r11")

ApDraws = dict[CurveKey, list[AveragePrecision]]
IntervalTree = dict[str, Any]
"""As `ApTree`, with [low, high] in place of each number."""


@dataclass(frozen=True, slots=True)
class Drop:
    """AP that the second model loses against the first, in points (negative: it gains).

    Attributes:
        points: on the frames as they are.
        interval95: 95 % of the draws lie within.
    """

    points: ApTree
    interval95: IntervalTree


def frame_weights(frames: int, *, draws: int = DRAWS, seed: int = SEED) -> IntArray:
    """How often each frame is drawn: (draws, frames), rows sum to ``frames``; same arguments, same draws."""
    if frames == 0:
        return np.zeros((draws, 0), dtype=np.int64)
    generator = np.random.default_rng(seed)
    return generator.multinomial(frames, np.full(frames, 1.0 / frames), size=draws)


def ap_interval95(evaluation: Evaluation, draws: ApDraws) -> IntervalTree:
    """The 95 % interval of each AP."""
    return tree_of(evaluation, lambda key, level: _intervals(draws[key][level], None))


def ap_drop(reference: Evaluation, other: Evaluation, *, reference_draws: ApDraws, other_draws: ApDraws) -> Drop:
    """What ``other`` loses against ``reference`` on the same frames.

    Args:
        reference, other: match records of the two models on the same labelled frames.
        reference_draws, other_draws: their AP under the same weights.

    Raises:
        FormatError: the models were not scored on the same frames.
    """
    if reference.frames != other.frames:
        raise FormatError(
            f"one model was scored on {reference.frames} frames and the other on {other.frames}, "
            "expected the same frames; score both on one source"
        )
    shared = Evaluation(
        frames=reference.frames,
        records={key: value for key, value in reference.records.items() if key in other.records},
        objects=reference.objects,
        with_orientation=reference.with_orientation & other.with_orientation,
    )
    first, second = reference.ap(), other.ap()
    return Drop(
        points=_difference(first, second),
        interval95=tree_of(shared, lambda key, level: _intervals(reference_draws[key][level], other_draws[key][level])),
    )


def _intervals(first: AveragePrecision, second: AveragePrecision | None) -> dict[str, list[float]]:
    return {
        name: _interval(getattr(first, name) - (0.0 if second is None else getattr(second, name))) for name in _VALUES
    }


def _interval(values: FloatArray) -> list[float]:
    low, high = np.percentile(values, PERCENTILES)
    return [float(low), float(high)]


def _difference(first: Any, second: Any) -> Any:
    if isinstance(first, dict):
        return {key: _difference(first[key], second[key]) for key in first if key in second}
    return [left - right for left, right in zip(first, second, strict=True)]
