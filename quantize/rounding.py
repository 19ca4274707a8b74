"""Rounding that looks at the outputs: each weight goes up or down so that a convolution's sums stay right.

To the nearest level is best for one weight alone. A convolution sums many products of inputs that are related
(neighbouring pixels, channels that fire together), so the error of one weight can be made good by another: what
AdaRound learns by gradient descent (Nagel et al., Up or Down?, 2020), and what GPTQ has in closed form (Frantar et al.,
2022; in the form of Babai's nearest plane): weights are rounded one after the other, and each takes on, by the inputs'
second moments, what the errors so far did to the output. The inputs' own rounding counts as noise that is related to
nothing. An output channel for which this is no better than the nearest levels keeps those. Costs nothing at run time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
import onnx
from numpy.typing import NDArray

from calib.cache import load, store
from calib.choice import Choice
from calib.frames import frame_feeds
from calib.methods import Range
from calib.ranges import Feeds, Observation, Progress, no_progress
from quantize.calibration import CORRECTION_FRAMES, Calibration, run_key, tensor_bytes
from quantize.graph import GraphIndex, attribute
from quantize.prepare import Prepared
from quantize.qdq import Levels
from quantize.qparams import activation_params, largest_level, quantize_weight, weight_scales
from quantize.static import build
from quantize.window_moments import MomentBlock, window_moments

_DAMPING = 0.01
"""Of the mean moment, added to each: a sample of windows knows rare directions badly."""
_AT_ONCE = 128
"""Columns that take on the errors of all before them in one product."""
_STAGE = "rounding weights"
_METHOD = "rounded weights, 2"
"""Names what is kept; another number for another way of rounding."""


def roundings(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    choice: Choice,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Levels:
    """Levels of the weights by what the first few calibration frames show; none where the recipe keeps the nearest.

    Args:
        prepared: The float model.
        calibration: Of its whole placement.
        ranges: Of its tensors, those that the build will use.
        choice: The calibration frames, their source still entered.
        use_cache: Look for, and keep, the result in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame and every convolution.
    """
    if not prepared.recipe.output_rounding:
        return {}
    nearest = build(prepared, calibration.observation, ranges).model
    few = calibration.frames.first(CORRECTION_FRAMES)
    key = run_key(prepared, nearest, few, tensors=(_METHOD, str(CORRECTION_FRAMES)))
    seen = load(key) if use_cache else None
    if seen is not None:
        return {name: levels for name, (levels, _) in seen.channels.items()}
    found = rounded_weights(
        prepared,
        ranges,
        lambda: frame_feeds(
            choice.frames(CORRECTION_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig
        ),
        bytes_of=tensor_bytes(prepared),
        frame_count=len(few.frames),
        progress=progress,
    )
    if use_cache:
        store(key, Observation({}, {name: (levels, levels[:0]) for name, levels in found.items()}, CORRECTION_FRAMES))
    return found


def rounded_weights(
    prepared: Prepared,
    ranges: Mapping[str, Range],
    feeds: Callable[[], Iterable[Feeds]],
    *,
    bytes_of: Mapping[str, int] | None = None,
    frame_count: int = 0,
    progress: Progress = no_progress,
) -> dict[str, NDArray[np.int8]]:
    """Levels of the weights of all 2D convolutions in 8 bits; others are left to the nearest level.

    Args:
        prepared: The float model and its placement.
        ranges: Of its tensors, those that the build will use.
        feeds: Starts an iteration over the calibration frames' feeds.
        bytes_of: Size of each tensor of the graph.
        frame_count: How many frames to expect, for progress alone.
        progress: Told after every frame and every convolution.

    Raises:
        QuantizeError: There are no frames.
    """
    index, recipe = GraphIndex(prepared.model), prepared.recipe
    nodes = _two_dimensional(prepared, index)
    weights = {node.name: _weight(index, node) for node in nodes}
    moments = window_moments(
        prepared.model,
        nodes,
        {name: weight.shape for name, weight in weights.items()},
        feeds,
        bytes_of=bytes_of,
        frame_count=frame_count,
        progress=progress,
    )
    found = {}
    inputs = {node.name: node.input[0] for node in nodes}
    for name, blocks in moments:
        weight = weights[name]
        scales = weight_scales(weight, bits=recipe.weight_bits, per_channel=recipe.weight_per_channel)
        found[name] = round_by_moments(
            weight,
            np.broadcast_to(scales, len(weight)),
            blocks,
            bits=recipe.weight_bits,
            input_noise=_rounding_noise(prepared, inputs[name], ranges),
        )
        progress(_STAGE, len(found), len(nodes))
    return found


def round_by_moments(
    weight: NDArray[np.float32],
    scales: NDArray[np.float32],
    blocks: Sequence[MomentBlock],
    *,
    bits: int,
    input_noise: float = 0.0,
) -> NDArray[np.int8]:
    """The levels of one convolution's weights.

    Args:
        weight: (M, ...) float weights.
        scales: (M,) what a level stands for.
        blocks: Moments that together cover the weights.
        bits: 8 or 7.
        input_noise: Mean square of what rounding adds to each input.
    """
    nearest = quantize_weight(weight, scales, bits=bits)
    levels = nearest.reshape(len(weight), -1).copy()
    in_steps = weight.reshape(len(weight), -1).astype(np.float64) / scales.astype(np.float64)[:, None]
    for block in blocks:
        here = (block.rows, block.columns)
        moments = block.moments.astype(np.float64)
        moments[np.diag_indices(len(moments))] += input_noise + _DAMPING * np.trace(moments) / len(moments)
        if not np.trace(moments) > 0:
            continue  # nothing but zeros was read
        tried = _spread_errors(in_steps[here], moments, largest=largest_level(bits))
        better = _error(tried - in_steps[here], moments) < _error(levels[here] - in_steps[here], moments)
        levels[here] = np.where(better[:, None], tried, levels[here])
    return levels.reshape(weight.shape)


def _spread_errors(weight: NDArray[np.float64], moments: NDArray[np.float64], *, largest: int) -> NDArray[np.int8]:
    """(M, K) weights in steps to levels, column by column, those first whose inputs are largest.

    With the moments' Cholesky factor L the error at the output is |L' e|^2, whose terms depend on ever fewer columns:
    taken from the last one back, each column can bring the term that it is the first of down to half a step.
    """
    order = np.argsort(np.diag(moments), kind="stable")
    factor = np.linalg.cholesky(moments[np.ix_(order, order)])
    share = factor / np.diag(factor)
    sorted_weight = weight[:, order]
    levels, errors = np.empty_like(sorted_weight), np.zeros_like(sorted_weight)
    for last in range(len(order), 0, -_AT_ONCE):
        first = max(last - _AT_ONCE, 0)
        wanted = sorted_weight[:, first:last] + errors[:, last:] @ share[last:, first:last]
        for column in range(last - 1, first - 1, -1):
            taken_on = errors[:, column + 1 : last] @ share[column + 1 : last, column]
            levels[:, column] = np.clip(np.rint(wanted[:, column - first] + taken_on), -largest, largest)
            errors[:, column] = sorted_weight[:, column] - levels[:, column]
    found = np.empty(weight.shape, np.int8)
    found[:, order] = levels
    return found


def _error(error: NDArray[np.float64], moments: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M,) mean square of what an error of the weights does to each output."""
    return np.einsum("mk,mk->m", error @ moments, error)


def _two_dimensional(prepared: Prepared, index: GraphIndex) -> list[onnx.NodeProto]:
    """The 8-bit convolutions over images, with explicit padding."""
    return [
        node
        for node in prepared.model.graph.node
        if node.op_type == "Conv"
        and node.name in prepared.placement.nodes
        and _weight(index, node).ndim == 4
        and attribute(node, "auto_pad", b"NOTSET") == b"NOTSET"
    ]


def _weight(index: GraphIndex, node: onnx.NodeProto) -> NDArray[np.float32]:
    weight = index.constant(node.input[1])
    assert weight is not None  # placement took only such
    return weight


def _rounding_noise(prepared: Prepared, tensor: str, ranges: Mapping[str, Range]) -> float:
    """Mean square error of a tensor in 8 bits: a twelfth of a squared step; 0 for pixels, which are bytes anyway."""
    placement = prepared.placement
    root = placement.root_of.get(tensor, tensor)
    if root in placement.given or root not in ranges:
        return 0.0
    low, high = ranges[root]
    recipe = prepared.recipe
    return (
        activation_params(low, high, dtype=recipe.activation_type, symmetric=recipe.activation_symmetric).scale ** 2
        / 12
    )
