"""Times the concatenation volume's two convolutions in float and in 8 bits, in three dimensions and in two.

``python tests/benchmarks/volume_convolutions.py [--runs N]``: the table of docs/int8-targets.md. All four go from an
8-bit volume to 8-bit features, with the same random weights, take turns, and are timed by the thread's processor time.
"""

from __future__ import annotations

import argparse
import statistics
import time
from itertools import product

import numpy as np
import onnx
import typer
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from quantize.volumes import flatten_volumes
from runtime.session import open_session

SHAPES = {"compact": (8, 6, 12, 56), "paper": (8, 12, 18, 80)}
"""Features, shifts, rows, columns."""
SCALE = np.float32(0.02)
BRIGHTEST = 60  # of the random volume's 256 levels: two layers later nothing has saturated


def float_model(features: int, shifts: int, rows: int, columns: int) -> onnx.ModelProto:
    """Two 3x3x3 convolutions with Relu; float in and out."""
    random = np.random.default_rng(0)
    constants: dict[str, NDArray[np.generic]] = {"shape": np.array([1, features * shifts, rows, columns], np.int64)}
    nodes, last = [], "volume"
    for number, channels in enumerate((2 * features, features)):
        spread = (2 / (27 * channels)) ** 0.5
        constants[f"w{number}"] = random.normal(0, spread, (features, channels, 3, 3, 3)).astype(np.float32)
        constants[f"b{number}"] = np.zeros(features, np.float32)
        inputs = [last, f"w{number}", f"b{number}"]
        nodes.append(helper.make_node("Conv", inputs, [f"c{number}"], name=f"conv{number}", pads=[1] * 6))
        nodes.append(helper.make_node("Relu", [f"c{number}"], [f"r{number}"], name=f"relu{number}"))
        last = f"r{number}"
    nodes.append(helper.make_node("Reshape", [last, "shape"], ["features"], name="reshape"))
    graph = helper.make_graph(
        nodes,
        "volume",
        [helper.make_tensor_value_info("volume", TensorProto.FLOAT, [1, 2 * features, shifts, rows, columns])],
        [helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, features * shifts, rows, columns])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def byte_ends(model: onnx.ModelProto, *, inner: bool) -> bytes:
    """The same with 8-bit input and output; with ``inner`` also 8-bit weights and everything between."""
    graph = model.graph
    weights = {item.name: numpy_helper.to_array(item) for item in graph.initializer}
    graph.initializer.append(numpy_helper.from_array(SCALE, "scale"))
    graph.initializer.append(numpy_helper.from_array(np.uint8(0), "zero"))
    nodes = [helper.make_node("DequantizeLinear", ["volume", "scale", "zero"], ["volume_float"])]
    names = {"volume": "volume_float"}
    for node in graph.node:
        node.input[:] = [names.get(name, name) for name in node.input]
        if inner and node.op_type == "Conv":
            nodes += _byte_weights(graph, node, weights)
        ends = "features" in node.output
        if ends or (inner and node.op_type == "Relu"):
            result = node.output[0]
            node.output[0] = f"{result}_float"
            nodes += [node, helper.make_node("QuantizeLinear", [node.output[0], "scale", "zero"], [f"{result}_bytes"])]
            if ends:
                nodes[-1].output[0] = result
            else:
                nodes.append(helper.make_node("DequantizeLinear", [f"{result}_bytes", "scale", "zero"], [result]))
        else:
            nodes.append(node)
    copies = [onnx.NodeProto.FromString(node.SerializeToString()) for node in nodes]
    del graph.node[:], graph.value_info[:]
    graph.node.extend(copies)
    for item in (*graph.input, *graph.output):
        item.type.tensor_type.elem_type = TensorProto.UINT8
    onnx.checker.check_model(model)
    serialised: bytes = model.SerializeToString()
    return serialised


def _byte_weights(
    graph: onnx.GraphProto, node: onnx.NodeProto, weights: dict[str, NDArray[np.float32]]
) -> list[onnx.NodeProto]:
    weight, bias = (weights[name] for name in node.input[1:3])
    step = (np.abs(weight).reshape(len(weight), -1).max(axis=1) / 127).astype(np.float32)
    levels = np.rint(weight / step.reshape(-1, *[1] * (weight.ndim - 1))).astype(np.int8)
    made = []
    for position, value, scale in ((1, levels, step), (2, bias.astype(np.int32), step * SCALE)):
        name = f"{node.name}.{position}"
        graph.initializer.append(numpy_helper.from_array(value, f"{name}.bytes"))
        graph.initializer.append(numpy_helper.from_array(scale, f"{name}.scale"))
        made.append(helper.make_node("DequantizeLinear", [f"{name}.bytes", f"{name}.scale"], [f"{name}.float"], axis=0))
        node.input[position] = f"{name}.float"
    return made


def main() -> None:
    """Times and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=20)
    runs = parser.parse_args().runs
    for preset, shape in SHAPES.items():
        sessions, times = {}, {}
        for inner, planes in product((False, True), (False, True)):
            model = float_model(*shape)
            model = flatten_volumes(model).model if planes else model
            name = f"{'INT8' if inner else 'float'} {'2D' if planes else '3D'}"
            sessions[name] = open_session(byte_ends(model, inner=inner), threads=1)
            times[name] = []
        size = (1, 2 * shape[0], *shape[1:])
        feed = {"volume": np.random.default_rng(1).integers(0, BRIGHTEST, size, dtype=np.uint8)}
        for _ in range(runs):
            for name, session in sessions.items():
                began = time.thread_time()
                session.run(feed)
                times[name].append(time.thread_time() - began)
        for name, session in sessions.items():
            session.close()
            typer.echo(f"{preset:8} {name:9} {statistics.median(times[name]) * 1e3:6.2f} ms")


if __name__ == "__main__":
    main()
