"""Decides which nodes compute in 8 bits, and which tensors share a scale.

Three kinds of operators are told apart. *Products* (convolutions, correlations) are what INT8 is for and
are always taken. *Blends* (Add, Concat, pools) make new values, so their output has a range of its own;
they are taken where they stand between 8-bit nodes, as a float island would cost a DequantizeLinear and a
QuantizeLinear. *Moves* (Slice, Reshape, MaxPool, ...) only pass values on, so their output keeps the scale
of their input. Each rule either takes a node or says why not.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np
import onnx

from quantize.ends import network_ends
from quantize.graph import GraphIndex, attribute
from quantize.recipe import Recipe
from runtime.contracts.correlation import DOMAIN, STEREO_CORRELATION

PRODUCTS = frozenset({"Conv", STEREO_CORRELATION})
BLENDS = frozenset({"Add", "Concat", "AveragePool", "GlobalAveragePool"})
MOVES = frozenset(
    {"MaxPool", "Reshape", "Transpose", "Slice", "Split", "Squeeze", "Unsqueeze", "Flatten", "Pad", "Relu"}
)


@dataclass(frozen=True, slots=True)
class Placement:
    """Where 8 bits are used.

    Attributes:
        nodes: names of the nodes that compute in 8 bits (ReLUs that vanish into them not counted).
        outputs: node -> the tensors that it gives, behind the ReLU that vanishes into it.
        folded: names of the ReLUs that vanish.
        root_of: 8-bit tensor -> the tensor whose range it takes (itself, but for moves).
        column_outputs: convolution whose output leaves the 8-bit part -> columns of the graph's output; each column
            gets a range of its own.
        exact_outputs: convolution whose output leaves the 8-bit part unrounded -> the tensor with channels last that
            its sums become.
        given: float tensors that are 8-bit already (pixels), by name, with their 8-bit tensor, scale, zero
        point. kept_float: node -> why, for nodes that the recipe's operators name.
    """

    nodes: frozenset[str]
    outputs: Mapping[str, tuple[str, ...]]
    folded: frozenset[str]
    root_of: Mapping[str, str]
    column_outputs: Mapping[str, int]
    given: Mapping[str, tuple[str, str, str]]
    exact_outputs: Mapping[str, str] = field(default_factory=dict)
    kept_float: Mapping[str, str] = field(default_factory=dict)

    @property
    def observed(self) -> tuple[str, ...]:
        """Tensors whose ranges are needed, in the order of the graph."""
        return tuple(dict.fromkeys(root for root in self.root_of.values() if root not in self.given))

    @property
    def observed_channels(self) -> tuple[str, ...]:
        """Tensors whose channel extremes are needed."""
        return tuple(self.outputs[name][0] for name in self.column_outputs)


def place(model: onnx.ModelProto, recipe: Recipe, excluded: Collection[str] = ()) -> Placement:
    """Places a recipe on a graph.

    Args:
        model: The float model, nodes named.
        recipe: What to quantise and how.
        excluded: Names of nodes that stay float.
    """
    index = GraphIndex(model)
    given = {
        node.output[0]: (node.input[0], node.input[1], node.input[2])
        for node in model.graph.node
        if node.op_type == "DequantizeLinear" and len(node.input) == 3 and node.input[1] in index.initializers
    }
    outputs, folded = _with_relu(index)
    reasons: dict[str, str] = {}
    taken: dict[str, onnx.NodeProto] = {}
    for node in model.graph.node:
        if node.op_type not in recipe.operators and node.op_type != "Relu":
            continue
        if node.name in folded:
            continue
        reason = "given back to float" if node.name in excluded else _refuse(node, index)
        if reason is None:
            taken[node.name] = node
        elif node.op_type in recipe.operators:
            reasons[node.name] = reason
    _settle(taken, reasons, index=index, outputs=outputs, given=given)
    ends = network_ends(taken, index=index, outputs=outputs) if recipe.column_outputs or recipe.exact_outputs else {}
    exact = {name: end.channels_last for name, end in ends.items() if recipe.exact_outputs and end.is_product}
    columns = {name: end.columns for name, end in ends.items() if recipe.column_outputs and name not in exact}
    return Placement(
        nodes=frozenset(taken),
        outputs={name: outputs[name] for name in taken},
        folded=frozenset(name for name, unit in folded.items() if unit in taken),
        root_of=_roots(model, taken, outputs=outputs, ends={*exact, *columns}, given=given),
        column_outputs=columns,
        given=given,
        exact_outputs=exact,
        kept_float=reasons,
    )


def activations(node: onnx.NodeProto) -> list[str]:
    """The inputs of a quantised node that are activations, not weights or shapes."""
    count = {STEREO_CORRELATION: 2, "Add": 2, "Concat": len(node.input)}.get(node.op_type, 1)
    return list(node.input[:count])


def moves(node: onnx.NodeProto, root_of: Mapping[str, str]) -> bool:
    """Whether a node only passes values on: a move, or a Concat of tensors of one scale."""
    if node.op_type == "Concat":
        return len({root_of.get(name, name) for name in node.input}) == 1
    return node.op_type in MOVES


def _with_relu(index: GraphIndex) -> tuple[dict[str, tuple[str, ...]], dict[str, str]]:
    """Outputs of each node behind the ReLU that can vanish into it, and those ReLUs with their node.

    Where zero is the lowest level, saturating is a ReLU.
    """
    outputs, folded = {}, {}
    for node in index.model.graph.node:
        outputs[node.name] = tuple(node.output)
        if node.op_type not in ("Conv", "Add"):
            continue
        reader = index.only_consumer(node.output[0])
        if reader is not None and reader.op_type == "Relu":
            outputs[node.name] = tuple(reader.output)
            folded[reader.name] = node.name
    return outputs, folded


def _refuse(node: onnx.NodeProto, index: GraphIndex) -> str | None:
    """Why a node cannot be quantised at all, None where it can."""
    if node.op_type == "Conv" and index.constant(node.input[1]) is None:
        return "its weight is computed"
    if node.op_type == "Conv" and len(node.input) > 2 and index.constant(node.input[2]) is None:
        return "its bias is computed"
    if node.op_type == STEREO_CORRELATION and node.domain != DOMAIN:
        return "it is of another domain"
    if node.op_type in BLENDS and any(name in index.initializers for name in node.input):
        return "one of its operands is constant"
    if node.op_type == "Pad":
        value = index.constant(node.input[2]) if len(node.input) > 2 and node.input[2] else np.zeros(())
        if attribute(node, "mode", b"constant") != b"constant" or value is None or np.any(value != 0):
            return "it pads with something else than zero"
    if node.op_type == "Relu":
        source = index.producer.get(node.input[0])
        if source is None or source.op_type != "Relu":
            return "it does not follow a node that it can vanish into"
    return None


def _settle(
    taken: dict[str, onnx.NodeProto],
    reasons: dict[str, str],
    *,
    index: GraphIndex,
    outputs: Mapping[str, tuple[str, ...]],
    given: Mapping[str, tuple[str, str, str]],
) -> None:
    """Drops blends and moves that do not stand between 8-bit nodes, until nothing changes."""
    changed = True
    while changed:
        made = {name for unit in taken for name in outputs[unit]} | set(given)
        read = {name for node in taken.values() for name in activations(node)}
        changed = False
        for name, node in list(taken.items()):
            if node.op_type in PRODUCTS:
                continue
            reads = [tensor in made for tensor in activations(node)]
            if not (all(reads) if node.op_type in MOVES else any(reads)):
                reason = "what it reads is float"
            elif not any(tensor in read for tensor in outputs[name]):
                reason = "what reads it is float"
            else:
                continue
            del taken[name]
            reasons[name] = reason
            changed = True


def _roots(
    model: onnx.ModelProto,
    taken: Mapping[str, onnx.NodeProto],
    *,
    outputs: Mapping[str, tuple[str, ...]],
    ends: Collection[str],
    given: Mapping[str, tuple[str, str, str]],
) -> dict[str, str]:
    """8-bit tensors with the tensor whose range they take."""
    root_of = {name: name for name in given}
    for node in model.graph.node:
        if node.name not in taken:
            continue
        for name in activations(node):
            root_of.setdefault(name, name)
        if node.name in ends:
            continue
        inherits = moves(node, root_of)
        for name in outputs[node.name]:
            root_of[name] = root_of[node.input[0]] if inherits else name
    return root_of
