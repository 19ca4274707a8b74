"""Computes 3D convolutions over a few planes as 2D ones, whose 8-bit kernels are several times as fast.

A tensor [B, C, D, H, W] is, byte for byte, one of [B, C D, H, W], and a convolution over D, H and W is one over H
and W alone between those channels: output (o, e) reads input (c, d) by the tap k of the depth for which
``d = stride e + dilation k - pad``, and by zero where there is none. The zeros make D / 3 times as many products of a
kernel of three; QLinearConv still takes a fifth of its time for them, since ONNX Runtime's 8-bit kernel is slow in
three dimensions (slower than its float one). The numbers added are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from quantize.graph import GraphIndex, attribute, prune, tensor_shapes

MAX_DEPTH = 16
"""Planes beyond which the zeros cost more than the kernel gains (at 12 a gain of 5.7, falling with the depth)."""
_SPATIAL = ("strides", "dilations")


@dataclass(frozen=True, slots=True)
class VolumeFlattening:
    """What came of it.

    Attributes:
        model: the new model; the old one where nothing was flattened.
        flattened: names of the convolutions that are 2D now.
        kept: other 3D convolutions, with the reason.
    """

    model: onnx.ModelProto
    flattened: tuple[str, ...]
    kept: dict[str, str]


def flatten_volumes(model: onnx.ModelProto) -> VolumeFlattening:
    """Turns each 3D convolution into a 2D one of the same name, between two Reshapes.

    A Relu behind it moves before the second Reshape, so that it can still vanish into the convolution; two Reshapes in
    a row that undo each other go.

    Args:
        model: The float model, nodes named; left as it is.
    """
    work = onnx.ModelProto()
    work.CopyFrom(model)
    index, shapes = GraphIndex(work), tensor_shapes(work)
    solid = [node for node in work.graph.node if node.op_type == "Conv" and len(shapes.get(node.input[1], ())) == 5]
    kept = {node.name: reason for node in solid if (reason := _refuse(node, index, shapes)) is not None}
    chosen = {node.name for node in solid} - set(kept)
    if not chosen:
        return VolumeFlattening(model, (), kept)
    flat: dict[str, str] = {}  # tensor of three dimensions -> the same bytes in two
    moved: set[str] = set()
    nodes: list[onnx.NodeProto] = []
    for node in work.graph.node:
        if node.name in moved:
            continue
        if node.name in chosen:
            relu = index.only_consumer(node.output[0])
            relu = relu if relu is not None and relu.op_type == "Relu" else None
            nodes += _flattened(work.graph, node, relu, index=index, shapes=shapes, flat=flat)
            moved |= set() if relu is None else {relu.name}
        else:
            same = flat.get(node.input[0]) if node.op_type == "Reshape" else None
            if same is not None and shapes.get(same, ()) == shapes.get(node.output[0]):
                node.input[0] = same
            nodes.append(node)
    copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del work.graph.node[:]
    work.graph.node.extend(copies)
    prune(work)
    return VolumeFlattening(work, tuple(node.name for node in solid if node.name in chosen), kept)


def flat_weight(
    weight: NDArray[np.float32], in_depth: int, out_depth: int, *, stride: int, dilation: int, pad: int
) -> NDArray[np.float32]:
    """(O, C, K, h, w) over ``in_depth`` planes to (O out_depth, C in_depth, h, w)."""
    outputs, channels, taps, *window = weight.shape
    flat = np.zeros((outputs, out_depth, channels, in_depth, *window), weight.dtype)
    for plane in range(out_depth):
        for tap in range(taps):
            source = stride * plane + dilation * tap - pad
            if 0 <= source < in_depth:
                flat[:, plane, :, source] = weight[:, :, tap]
    return flat.reshape(outputs * out_depth, channels * in_depth, *window)


def _refuse(node: onnx.NodeProto, index: GraphIndex, shapes: dict[str, tuple[int, ...]]) -> str | None:
    """Why a 3D convolution stays as it is, None where it need not."""
    if any(len(shapes.get(name, ())) != 5 for name in (node.input[0], node.output[0])):
        return "its shapes are not known"
    if index.constant(node.input[1]) is None or (len(node.input) > 2 and index.constant(node.input[2]) is None):
        return "its weight or bias is computed"
    if attribute(node, "group", 1) != 1:
        return "it has groups"
    if attribute(node, "auto_pad", b"NOTSET") != b"NOTSET":
        return "its padding is not written out"
    if shapes[node.input[0]][2] > MAX_DEPTH:
        return f"it has more than {MAX_DEPTH} planes"
    return None


def _flattened(
    graph: onnx.GraphProto,
    node: onnx.NodeProto,
    relu: onnx.NodeProto | None,
    *,
    index: GraphIndex,
    shapes: dict[str, tuple[int, ...]],
    flat: dict[str, str],
) -> list[onnx.NodeProto]:
    """The nodes that take a convolution's place (and its Relu's); notes in ``flat`` what they give."""
    source, result = shapes[node.input[0]], shapes[node.output[0]]
    strides, dilations = (list(attribute(node, name, [1, 1, 1])) for name in _SPATIAL)
    pads = list(attribute(node, "pads", [0] * 6))
    weight = index.constant(node.input[1])
    assert weight is not None  # _refuse checked
    planes = flat_weight(weight, source[2], result[2], stride=strides[0], dilation=dilations[0], pad=pads[0])
    inputs = [f"{node.name}.flat_input", f"{node.name}.flat_weight"]
    _add_constant(graph, inputs[1], planes)
    if len(node.input) > 2:
        bias = index.constant(node.input[2])
        assert bias is not None  # _refuse checked
        inputs.append(f"{node.name}.flat_bias")
        _add_constant(graph, inputs[2], np.repeat(bias, result[2]))
    made: list[onnx.NodeProto] = []
    if node.input[0] in flat:
        inputs[0] = flat[node.input[0]]
    else:
        made.append(_reshape(graph, f"{node.name}.flatten", node.input[0], inputs[0], shape=_flat_shape(source)))
    last = f"{node.name}.flat_output"
    convolution = helper.make_node(
        "Conv",
        inputs,
        [last],
        name=node.name,
        strides=strides[1:],
        dilations=dilations[1:],
        pads=[*pads[1:3], *pads[4:6]],
        kernel_shape=planes.shape[2:],
    )
    made.append(convolution)
    shapes[last] = _flat_shape(result)
    end = node.output[0]
    if relu is not None:
        made.append(helper.make_node("Relu", [last], [f"{node.name}.flat_relu"], name=relu.name))
        last, end = f"{node.name}.flat_relu", relu.output[0]
        shapes[last] = _flat_shape(result)
    flat[end] = last
    made.append(_reshape(graph, f"{node.name}.unflatten", last, end, shape=result))
    return made


def _flat_shape(shape: tuple[int, ...]) -> tuple[int, ...]:
    batch, channels, depth, *size = shape
    return (batch, channels * depth, *size)


def _reshape(graph: onnx.GraphProto, name: str, source: str, result: str, *, shape: tuple[int, ...]) -> onnx.NodeProto:
    _add_constant(graph, f"{name}.shape", np.array(shape, np.int64))
    return helper.make_node("Reshape", [source, f"{name}.shape"], [result], name=name)


def _add_constant(graph: onnx.GraphProto, name: str, value: NDArray[Any]) -> None:
    graph.initializer.append(numpy_helper.from_array(value, name))
