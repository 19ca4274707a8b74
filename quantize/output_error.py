"""How far an INT8 graph's outputs are from the float graph's, in one number that follows what detections need.

Error of an inner tensor says little: a clipped peak of a stem and a rounded pixel may have the same mean square and not
the same effect. So the error is taken where the network ends, squared, each column in units of its own variance, and
averaged over anchors with the float model's own class probability as weight: a background anchor's box is never read.
Depth and class logits count `DECISIVE_WEIGHT` times: a box a metre off in depth misses its object in 3D, and scores
decide which of neighbouring anchors survives suppression. (Bundled model, 100 development frames: with the INT8 scores
and float boxes the mean centre shift was 11 cm, with float scores and the INT8 boxes 9 cm, with both INT8 19 cm; what
Pedestrian lost in AP, it lost by the scores.)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import onnx
from numpy.typing import NDArray

from calib.ranges import Feeds
from runtime.boxcode import DELTA_COUNT
from runtime.session import open_session

DECISIVE_WEIGHT = 4.0
CLEARLY = 1.005
"""Relative: a graph that is behind by so much on half of the frames is not ahead on all of them."""
_LOGITS, _DELTAS = "cls_logits", "box_deltas"
_DEPTH_COLUMN = 6
_SMALLEST_VARIANCE = 1e-12


class OutputError:
    """Remembers what the float model gives on some frames; tells how far another graph is from it."""

    def __init__(self, model: onnx.ModelProto, feeds: Sequence[Feeds]) -> None:
        """Runs the float model once over the frames.

        Args:
            model: The float model.
            feeds: Its inputs on one or more frames; kept.
        """
        self._feeds = list(feeds)
        with open_session(model.SerializeToString(), name="float model") as session:
            names = [item.name for item in session.outputs]
            self._wanted = [session.run(feed) for feed in self._feeds]
        self._weights = [_anchor_weights(names, outputs) for outputs in self._wanted]
        self._column_weights = [_column_weights(name, self._wanted[0][at].shape[-1]) for at, name in enumerate(names)]
        self._total_weight = float(sum(weights.sum() for weights in self._weights))
        self._all_columns = float(sum(item.sum() for item in self._column_weights))
        self._variances = [self._variance(at) for at in range(len(names))]

    def of(self, model: onnx.ModelProto) -> float:
        """Weighted mean over columns of noise power over signal variance; 0 is equality, 1 is guessing the mean."""
        return sum(self.by_frame(model))

    def by_frame(self, model: onnx.ModelProto, *, rival: Sequence[float] = ()) -> list[float]:
        """What each frame adds to `of`.

        Args:
            model: A graph with the float model's inputs and outputs.
            rival: The same of another graph. Where half of the frames add clearly more than they do there, the others
                are not run and the list is as short.
        """
        found: list[float] = []
        with open_session(model.SerializeToString(), name="INT8 model") as session:
            for feed, wanted, weights in zip(self._feeds, self._wanted, self._weights, strict=True):
                found.append(self._added(wanted, session.run(feed), weights))
                if rival and 2 * len(found) >= len(self._feeds) and sum(found) > CLEARLY * sum(rival[: len(found)]):
                    break
        return found

    def _added(
        self,
        wanted: Sequence[NDArray[np.float32]],
        outputs: Sequence[NDArray[np.float32]],
        weights: NDArray[np.float64],
    ) -> float:
        total = 0.0
        for at, (signal, other) in enumerate(zip(wanted, outputs, strict=True)):
            power = _weighted((signal.astype(np.float64) - other) ** 2, weights)
            total += float((self._column_weights[at] * power / self._variances[at]).sum())
        return total / self._total_weight / self._all_columns

    def _variance(self, at: int) -> NDArray[np.float64]:
        """(columns,) of one output over the weighted anchors of all frames."""
        pairs = [(outputs[at].astype(np.float64), w) for outputs, w in zip(self._wanted, self._weights, strict=True)]
        mean = sum(_weighted(values, w) for values, w in pairs) / self._total_weight
        square = sum(_weighted((values - mean) ** 2, w) for values, w in pairs) / self._total_weight
        return np.asarray(np.maximum(square, _SMALLEST_VARIANCE), np.float64)


def _anchor_weights(names: Sequence[str], outputs: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """(N,) the largest class probability of each anchor; ones where there are no logits."""
    if _LOGITS not in names:
        return np.ones(outputs[0].shape[-2] if outputs[0].ndim > 1 else 1)
    best = outputs[names.index(_LOGITS)][0, :, :-1].max(axis=-1).astype(np.float64)
    return np.asarray(1.0 / (1.0 + np.exp(-best)), np.float64)


def _column_weights(name: str, columns: int) -> NDArray[np.float64]:
    weights = np.ones(columns)
    if name == _DELTAS and columns == DELTA_COUNT:
        weights[_DEPTH_COLUMN] = DECISIVE_WEIGHT
    if name == _LOGITS:
        weights[:-1] = DECISIVE_WEIGHT  # the last tells the facing
    return weights


def _weighted(values: NDArray[np.float64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """(columns,) sums over anchors; an output of other anchors counts them all alike."""
    rows = values.reshape(-1, values.shape[-1])
    if len(rows) != len(weights):
        weights = np.full(len(rows), weights.sum() / len(rows))
    return np.asarray(weights @ rows, np.float64)
