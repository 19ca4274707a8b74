"""Lets the first convolutions read camera pixels as they are.

An exported graph turns uint8 pixels v into ``x = a v + b`` for each channel before its first convolution.
Quantising x again would cost passes over the whole image in float and round twice. A pixel is already an
8-bit number, so the affine map moves into the convolution instead: ``conv(W, a v + b) = conv(a W, v - z) +
sum W (b + a z)``, with the pixel's zero point z the level closest to ``-b / a``, the mean colour. Inside
the image that is exact; a padded pixel counts as grey z where it counted as the mean colour before (for
ImageNet statistics, 0.13 standard deviations apart at most), seen by the outermost outputs alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from quantize.graph import GraphIndex, prune

PIXEL_SCALE = "pixel_scale"
PIXEL_ZERO_POINT = "pixel_zero_point"
_AFFINE = ("Mul", "Div", "Add", "Sub")


@dataclass(frozen=True, slots=True)
class _Pixels:
    """A float tensor that is an affine map of a uint8 one: ``x = gain * v + offset`` by channel."""

    source: str
    gain: NDArray[np.float64]
    offset: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PixelFolding:
    """What came of it.

    Attributes:
        model: the new model; the old one where nothing was folded.
        folded: names of the convolutions that now read pixels.
        reason: why nothing was folded; None where something was.
    """

    model: onnx.ModelProto
    folded: tuple[str, ...]
    reason: str | None


def fold_pixels(model: onnx.ModelProto) -> PixelFolding:
    """Moves the normalisation of uint8 inputs into the convolutions that read them.

    The result has ``DequantizeLinear(v, 1, z)`` before these convolutions: a float model as before, equal
    to the old one but for padded borders, whose first convolutions the quantiser finds ready to be fused.

    Args:
        model: The float model; left as it is.

    Returns:
        The new model, or the reason why the graph is not of this form.
    """
    work = onnx.ModelProto()
    work.CopyFrom(model)
    index = GraphIndex(work)
    bytes_inputs = [item.name for item in work.graph.input if item.type.tensor_type.elem_type == onnx.TensorProto.UINT8]
    if not bytes_inputs:
        return PixelFolding(model, (), "no input is uint8")
    known, joins = _follow(work, index, bytes_inputs)
    readers = [node for node in work.graph.node if any(name in known for name in node.input)]
    stems = [node for node in readers if node.op_type == "Conv" and node.input[0] in known]
    others = [node for node in readers if node not in stems and not any(name in known for name in node.output)]
    if not stems or others:
        culprit = others[0].op_type if others else "no convolution"
        return PixelFolding(model, (), f"normalised pixels are read by {culprit}, not by convolutions alone")
    for node in stems:
        weight = index.constant(node.input[1])
        channels = len(known[node.input[0]].gain)
        if weight is None or weight.shape[1] != channels:
            return PixelFolding(model, (), f"{node.name} has no constant weight over all {channels} channels")
    _rewrite(work, index, stems, known=known, joins=joins)
    prune(work)
    return PixelFolding(work, tuple(node.name for node in stems), None)


def _follow(
    model: onnx.ModelProto, index: GraphIndex, bytes_inputs: list[str]
) -> tuple[dict[str, _Pixels], dict[str, onnx.NodeProto]]:
    """Float tensors that are affine maps of pixels, and Concat nodes that join the bytes of joined views."""
    sources = {name: name for name in bytes_inputs}
    known: dict[str, _Pixels] = {}
    joins: dict[str, onnx.NodeProto] = {}
    for node in model.graph.node:
        first = node.input[0] if node.input else ""
        if node.op_type == "Cast" and first in sources and _to_float(node):
            known[node.output[0]] = _Pixels(sources[first], np.ones(1), np.zeros(1))
        elif node.op_type == "Concat" and all(name in sources for name in node.input):
            sources[node.output[0]] = node.output[0]
        elif node.op_type == "Concat" and all(name in known for name in node.input):
            parts = [known[name] for name in node.input]
            if _axis(node) == 0 and all(_same(part, parts[0]) for part in parts):
                name = f"{node.output[0]}_pixels"
                joins[name] = helper.make_node(
                    "Concat", [part.source for part in parts], [name], name=f"{node.name}_pixels", axis=0
                )
                known[node.output[0]] = _Pixels(name, parts[0].gain, parts[0].offset)
        elif node.op_type in _AFFINE:
            changed = _apply(node, index, known)
            if changed is not None:
                known[node.output[0]] = changed
    return known, joins


def _apply(node: onnx.NodeProto, index: GraphIndex, known: dict[str, _Pixels]) -> _Pixels | None:
    """The affine map after one more step; None where the step is not one by channel."""
    left, right = node.input
    reversed_operands = left not in known
    pixels = known.get(right if reversed_operands else left)
    constant = index.constant(left if reversed_operands else right)
    if pixels is None or constant is None or (reversed_operands and node.op_type in ("Div", "Sub")):
        return None
    step = _by_channel(constant)
    if step is None:
        return None
    gain, offset = pixels.gain, pixels.offset
    if node.op_type in ("Mul", "Div"):
        factor = step if node.op_type == "Mul" else 1 / step
        gain, offset = gain * factor, offset * factor
    else:
        offset = offset + (step if node.op_type == "Add" else -step)
    gain, offset = np.broadcast_arrays(gain, offset)
    return _Pixels(pixels.source, gain, offset)


def _by_channel(constant: NDArray[Any]) -> NDArray[np.float64] | None:
    """A constant that broadcasts over [B, C, H, W] by channel, as (C,) or (1,)."""
    if constant.size == 1:
        return constant.reshape(1).astype(np.float64)
    shape = (1,) * (4 - constant.ndim) + constant.shape
    if len(shape) == 4 and constant.size == shape[1]:
        return constant.reshape(-1).astype(np.float64)
    return None


def _rewrite(
    model: onnx.ModelProto,
    index: GraphIndex,
    stems: list[onnx.NodeProto],
    *,
    known: dict[str, _Pixels],
    joins: dict[str, onnx.NodeProto],
) -> None:
    """Gives each stem its folded weight, and its pixels through one DequantizeLinear a source."""
    graph = model.graph
    centred: dict[str, onnx.NodeProto] = {}
    stem_of: dict[str, str] = {}
    for number, stem in enumerate(stems):
        pixels, suffix = known[stem.input[0]], f"_{number + 1}" if number else ""
        weight = index.constant(stem.input[1])
        assert weight is not None  # fold_pixels checked
        bias = index.constant(stem.input[2]) if len(stem.input) > 2 else None
        gain = np.broadcast_to(pixels.gain, weight.shape[1])
        offset = np.broadcast_to(pixels.offset, weight.shape[1])
        zero_point = int(np.clip(np.rint(np.mean(-pixels.offset / pixels.gain)), 0, 255))
        by_channel = (1, -1, *[1] * (weight.ndim - 2))
        wide = weight.astype(np.float64)
        at_zero_point = wide * (offset + gain * zero_point).reshape(by_channel)
        total = at_zero_point.sum(axis=tuple(range(1, weight.ndim))) + (0 if bias is None else bias)
        if pixels.source not in centred:
            centred[pixels.source] = helper.make_node(
                "DequantizeLinear",
                [pixels.source, PIXEL_SCALE + suffix, PIXEL_ZERO_POINT + suffix],
                [f"{pixels.source}_centred"],
                name=f"{pixels.source}/centre",
            )
            _add_constant(graph, PIXEL_SCALE + suffix, np.array(1, np.float32))
            _add_constant(graph, PIXEL_ZERO_POINT + suffix, np.array(zero_point, np.uint8))
        names = [f"{stem.name}.pixel_weight", f"{stem.name}.pixel_bias"]
        _add_constant(graph, names[0], (wide * gain.reshape(by_channel)).astype(np.float32))
        _add_constant(graph, names[1], total.astype(np.float32))
        del stem.input[:]
        stem.input.extend([centred[pixels.source].output[0], *names])
        stem_of.setdefault(centred[pixels.source].name, stem.name)
    ordered: list[onnx.NodeProto] = []
    for node in graph.node:
        for source, centre in centred.items():
            if stem_of[centre.name] == node.name:
                ordered += [*([joins[source]] if source in joins else []), centre]
        ordered.append(node)
    copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in ordered]
    del graph.node[:]
    graph.node.extend(copies)


def _add_constant(graph: onnx.GraphProto, name: str, value: NDArray[Any]) -> None:
    graph.initializer.append(numpy_helper.from_array(value, name))


def _same(one: _Pixels, other: _Pixels) -> bool:
    return np.array_equal(one.gain, other.gain) and np.array_equal(one.offset, other.offset)


def _to_float(node: onnx.NodeProto) -> bool:
    return any(item.name == "to" and item.i == onnx.TensorProto.FLOAT for item in node.attribute)


def _axis(node: onnx.NodeProto) -> int:
    return next((int(item.i) for item in node.attribute if item.name == "axis"), 0)
