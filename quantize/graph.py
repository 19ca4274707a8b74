"""An index over an ONNX graph: who makes a tensor, who reads it, what is constant, and all shapes."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper, shape_inference

from runtime.contracts.correlation import (
    DOMAIN,
    MAX_DISPARITY,
    QLINEAR_STEREO_CORRELATION,
    STEREO_CORRELATION,
)

CORRELATIONS = (STEREO_CORRELATION, QLINEAR_STEREO_CORRELATION)


class GraphIndex:
    """Look-ups over one graph; made anew after the graph changed.

    Attributes:
        model: the model.
        producer: tensor -> the node that makes it.
        consumers: tensor -> the nodes that read it, in order.
        initializers: constant tensors by name.
        inputs, outputs: names of the graph's own.
    """

    def __init__(self, model: onnx.ModelProto) -> None:
        """Reads the graph once."""
        graph = model.graph
        self.model = model
        self.producer: dict[str, onnx.NodeProto] = {}
        self.consumers: dict[str, list[onnx.NodeProto]] = defaultdict(list)
        for node in graph.node:
            for name in node.output:
                self.producer[name] = node
            for name in dict.fromkeys(node.input):
                if name:
                    self.consumers[name].append(node)
        self.initializers = {tensor.name: tensor for tensor in graph.initializer}
        self.inputs = [item.name for item in graph.input if item.name not in self.initializers]
        self.outputs = [item.name for item in graph.output]

    def constant(self, name: str) -> NDArray[Any] | None:
        """Value of a constant tensor, None where it is computed."""
        tensor = self.initializers.get(name)
        return None if tensor is None else numpy_helper.to_array(tensor)

    def only_consumer(self, name: str) -> onnx.NodeProto | None:
        """The single reader of a tensor that is no output of the graph, else None."""
        readers = self.consumers.get(name, [])
        return readers[0] if len(readers) == 1 and name not in self.outputs else None


def attribute(node: onnx.NodeProto, name: str, default: Any = None) -> Any:
    """Value of a node's attribute."""
    for item in node.attribute:
        if item.name == name:
            return onnx.helper.get_attribute_value(item)
    return default


def name_nodes(model: onnx.ModelProto) -> None:
    """Gives every node without a name, or with one that is taken, a name of its own."""
    used: set[str] = set()
    for node in model.graph.node:
        base = node.name or node.op_type
        name, number = base, 1
        while name in used:
            number += 1
            name = f"{base}_{number}"
        node.name = name
        used.add(name)


def tensor_shapes(model: onnx.ModelProto) -> dict[str, tuple[int, ...]]:
    """Shapes of all tensors whose extents are known; correlations included."""
    work = onnx.ModelProto()
    work.CopyFrom(model)
    known: dict[str, tuple[int, ...]] = {}
    while True:
        inferred = shape_inference.infer_shapes(work)
        items = [*inferred.graph.value_info, *inferred.graph.input, *inferred.graph.output]
        known = {item.name: shape for item in items if (shape := _shape(item)) is not None}
        known.update({tensor.name: tuple(tensor.dims) for tensor in model.graph.initializer})
        found = [
            (node.output[0], volume_shape(known[node.input[0]], int(attribute(node, MAX_DISPARITY))))
            for node in model.graph.node
            if node.domain == DOMAIN and node.input[0] in known and node.output[0] not in known
        ]
        if not found:
            return known
        for name, shape in found:
            kind = _element_type(inferred, name)
            for stale in [item for item in work.graph.value_info if item.name == name]:
                work.graph.value_info.remove(stale)
            work.graph.value_info.append(onnx.helper.make_tensor_value_info(name, kind, shape))


def volume_shape(left: tuple[int, ...], max_disparity: int) -> tuple[int, ...]:
    """[B, C, H, W] and D to [B, D, H, W]."""
    return (left[0], max_disparity, *left[2:])


def multiply_adds(node: onnx.NodeProto, shapes: dict[str, tuple[int, ...]]) -> int:
    """Multiply-adds of one node: convolutions, matrix products and correlations; 0 for all others.

    A correlation counts D x C x H x W a batch item, its empty corner (x < d) included.
    """
    output = shapes.get(node.output[0])
    if output is None:
        return 0
    if node.op_type in ("Conv", "QLinearConv", "ConvTranspose"):
        weight = shapes.get(node.input[3 if node.op_type == "QLinearConv" else 1])
        return 0 if weight is None else int(np.prod(output) * np.prod(weight[1:]))
    if node.op_type in ("MatMul", "Gemm"):
        left = shapes.get(node.input[0])
        if left is None:
            return 0
        inner = left[0] if node.op_type == "Gemm" and attribute(node, "transA", 0) else left[-1]
        return int(np.prod(output)) * int(inner)
    if node.op_type in CORRELATIONS and node.domain == DOMAIN:
        left = shapes.get(node.input[0])
        return 0 if left is None else int(np.prod(output)) * left[1]
    return 0


def prune(model: onnx.ModelProto) -> None:
    """Removes nodes, constants and functions that no output depends on."""
    graph = model.graph
    needed = {item.name for item in graph.output}
    kept = []
    for node in reversed(graph.node):
        if any(name in needed for name in node.output):
            kept.append(node)
            needed.update(name for name in node.input if name)
    _replace_all(graph.node, list(reversed(kept)))
    _replace_all(graph.initializer, [tensor for tensor in graph.initializer if tensor.name in needed])
    _replace_all(graph.value_info, [])
    used = {(node.domain, node.op_type) for node in graph.node}
    _replace_all(model.functions, [f for f in model.functions if (f.domain, f.name) in used])


def _replace_all(field: Any, items: list[Any]) -> None:
    copies = [type(item).FromString(item.SerializeToString()) for item in items]
    del field[:]
    field.extend(copies)


def _shape(item: onnx.ValueInfoProto) -> tuple[int, ...] | None:
    if not item.type.tensor_type.HasField("shape"):
        return None
    dims = item.type.tensor_type.shape.dim
    if not all(dim.HasField("dim_value") for dim in dims):
        return None
    return tuple(dim.dim_value for dim in dims)


def _element_type(model: onnx.ModelProto, name: str) -> int:
    for item in model.graph.value_info:
        if item.name == name and item.type.tensor_type.elem_type:
            return int(item.type.tensor_type.elem_type)
    return int(onnx.TensorProto.FLOAT)
