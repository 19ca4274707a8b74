"""Bias correction: takes the mean error that 8 bits put on each channel out of the convolution's bias.

Rounded weights shift the mean of a channel by the sum of their errors times the mean of what they read; few
weights a channel, as in a depthwise convolution, leave much of it. The shift is a constant, so it goes into
the int32 bias and costs nothing at run time (Nagel et al., Data-Free Quantization, 2019, section 4.2, here
with measured means).

A layer's shift must be measured behind layers that are corrected already, else each would pay for the ones
before it once more. One pass a layer would take minutes. Here the float network and the INT8 one run side by
side in one graph, and behind every 8-bit convolution its mean distance to the float twin on this frame is
added at once, before the next layer reads it: one run a frame gives the shifts of all layers in sequence.
Their mean over frames is the correction.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from calib.ranges import Feeds, Progress, no_progress
from quantize.errors import QuantizeError
from quantize.graph import prune
from quantize.placement import Placement
from runtime.session import open_session

Shifts = Mapping[str, NDArray[np.float64]]
"""Convolution -> (M,) what its bias takes in addition, by output channel, in real units."""

_TWIN = "float_twin/"
_CHANNEL_AXIS = 1
_LAST_KEPT = "all_but_last_axis"


def bias_shifts(
    model: onnx.ModelProto,
    quantised: onnx.ModelProto,
    placement: Placement,
    feeds: Iterable[Feeds],
    *,
    frame_count: int = 0,
    progress: Progress = no_progress,
) -> Shifts:
    """Measures the correction of every 8-bit convolution.

    Args:
        model: The float model that was placed.
        quantised: The INT8 model written from it, without correction.
        placement: Where 8 bits are.
        feeds: The graph's inputs on some calibration frames.
        frame_count: How many of them to expect, for progress alone.
        progress: Told after every frame.

    Returns:
        Shifts by the convolution's name; empty where no convolution is in 8 bits.

    Raises:
        QuantizeError: There are no frames.
    """
    joined, shift_of = _side_by_side(model, quantised, placement)
    if not shift_of:
        return {}
    sums = {name: np.zeros(()) for name in shift_of}
    frames = 0
    with open_session(joined.SerializeToString(), name="float and INT8 model side by side") as session:
        for feed in feeds:
            found = session.run(feed, outputs=list(shift_of.values()))
            for name, shift in zip(shift_of, found, strict=True):
                sums[name] = sums[name] + shift.astype(np.float64).reshape(-1)
            frames += 1
            progress("correcting biases", frames, max(frame_count, frames))
    if frames == 0:
        raise QuantizeError("bias correction: found no frames; expected one or more; give a source with frames")
    return {name: total / frames for name, total in sums.items()}


def _side_by_side(
    model: onnx.ModelProto, quantised: onnx.ModelProto, placement: Placement
) -> tuple[onnx.ModelProto, dict[str, str]]:
    """Both networks in one graph, each 8-bit convolution pulled to its twin's mean; and convolution -> its shift."""
    joined = onnx.ModelProto()
    joined.CopyFrom(quantised)
    graph = joined.graph
    inputs = {item.name for item in model.graph.input}
    results = {node.name: node.output[0] for node in model.graph.node}
    shift_of: dict[str, str] = {}
    axes: dict[int, str] = {}
    ranks = {tensor.name: len(tensor.dims) for tensor in model.graph.initializer}
    weights = {node.name: node.input[1] for node in model.graph.node if node.op_type == "Conv"}

    nodes = list(_twin_nodes(model, inputs))
    for node in quantised.graph.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        nodes.append(copy)
        if node.name in placement.exact_outputs:  # a matrix product by now, its channels last
            raw, shift = placement.exact_outputs[node.name], f"{node.name}/shift"
            shift_of[node.name] = shift
            nodes.append(helper.make_node("Sub", [_TWIN + raw, raw], [f"{shift}/error"]))
            nodes.append(helper.make_node("ReduceMean", [f"{shift}/error", _LAST_KEPT], [shift], keepdims=1))
            continue
        if node.op_type != "Conv" or node.name not in placement.nodes:
            continue
        twin, shift = _TWIN + results[node.name], f"{node.name}/shift"
        axis_name = axes.setdefault(ranks[weights[node.name]], f"all_but_channels_{ranks[weights[node.name]]}")
        shift_of[node.name] = shift
        if node.name in placement.column_outputs:  # nothing reads it in 8 bits: compared as the output it becomes
            raw = results[node.name]
        else:
            raw = copy.output[0] = f"{node.output[0]}/uncorrected"
        nodes.append(helper.make_node("Sub", [twin, raw], [f"{shift}/error"]))
        nodes.append(helper.make_node("ReduceMean", [f"{shift}/error", axis_name], [shift], keepdims=1))
        if node.name not in placement.column_outputs:
            nodes.append(helper.make_node("Add", [raw, shift], [node.output[0]]))
    del graph.node[:]
    graph.node.extend(_in_order(nodes, inputs | {tensor.name for tensor in graph.initializer}, model))
    for tensor in model.graph.initializer:
        graph.initializer.add().CopyFrom(tensor)
        graph.initializer[-1].name = _TWIN + tensor.name
    if placement.exact_outputs:
        graph.initializer.append(numpy_helper.from_array(np.array([0, 1, 2], np.int64), _LAST_KEPT))
    for rank, name in axes.items():
        kept = np.array([axis for axis in range(rank) if axis != _CHANNEL_AXIS], np.int64)
        graph.initializer.append(numpy_helper.from_array(kept, name))
    known = {(function.domain, function.name) for function in joined.functions}
    joined.functions.extend(item for item in model.functions if (item.domain, item.name) not in known)
    del graph.output[:]
    for shift in shift_of.values():
        graph.output.append(helper.make_tensor_value_info(shift, onnx.TensorProto.FLOAT, None))
    if shift_of:
        prune(joined)
    return joined, shift_of


def _twin_nodes(model: onnx.ModelProto, inputs: set[str]) -> Iterable[onnx.NodeProto]:
    """The float network under other names, reading the same inputs."""
    for node in model.graph.node:
        copy = onnx.NodeProto()
        copy.CopyFrom(node)
        copy.name = _TWIN + node.name
        for names in (copy.input, copy.output):
            for position, name in enumerate(names):
                if name and name not in inputs:
                    names[position] = _TWIN + name
        yield copy


def _in_order(nodes: list[onnx.NodeProto], known: set[str], model: onnx.ModelProto) -> list[onnx.NodeProto]:
    """The nodes so that each follows those it reads: a column's error is made behind its DequantizeLinear."""
    made = {name for node in nodes for name in node.output}
    ready = set(known) | {_TWIN + tensor.name for tensor in model.graph.initializer}
    ordered: list[onnx.NodeProto] = []
    waiting = nodes
    while waiting:
        later = []
        for node in waiting:
            if all(not name or name in ready or name not in made for name in node.input):
                ordered.append(node)
                ready.update(node.output)
            else:
                later.append(node)
        if len(later) == len(waiting):
            raise QuantizeError("bias correction: found a graph with a cycle; expected none; export the model again")
        waiting = later
    return ordered
