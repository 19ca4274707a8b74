"""How long the correlation takes: native kernel, function body, and the chain of standard nodes it replaces.

Run ``python -m tests.benchmarks.correlation_speed`` or the file itself; decides no test.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import onnx
from onnx import TensorProto, helper

from export.function_body import stereo_correlation_function
from runtime.session import open_session

SHAPE, DISPARITIES = (1, 64, 72, 320), 24
REPEATS = 30
OPSETS = [helper.make_opsetid("", 18), helper.make_opsetid("edge.stereo", 1)]


def _model(nodes: list[onnx.NodeProto], *, functions: list[onnx.FunctionProto]) -> bytes:
    inputs = [helper.make_tensor_value_info(name, TensorProto.FLOAT, SHAPE) for name in ("left", "right")]
    outputs = [helper.make_tensor_value_info("volume", TensorProto.FLOAT, (1, DISPARITIES, *SHAPE[2:]))]
    graph = helper.make_graph(nodes, "speed", inputs, outputs)
    return helper.make_model(graph, opset_imports=OPSETS, ir_version=10, functions=functions).SerializeToString()


def custom_node() -> bytes:
    """One node with its function body."""
    node = helper.make_node(
        "StereoCorrelation", ["left", "right"], ["volume"], domain="edge.stereo", max_disparity=DISPARITIES
    )
    return _model([node], functions=[stereo_correlation_function(18)])


def standard_chain() -> bytes:
    """For each disparity Slice, Slice, Mul, ReduceMean, Pad; then Concat: what exporters make of the loop."""

    def constant(name: str, values: list[int]) -> onnx.NodeProto:
        return helper.make_node("Constant", [], [name], value_ints=values)

    nodes = [constant("zero", [0]), constant("one", [1]), constant("columns", [3])]
    for d in range(DISPARITIES):
        nodes += [
            constant(f"start{d}", [d]),
            constant(f"stop{d}", [SHAPE[3]]),
            constant(f"width{d}", [SHAPE[3] - d]),
            constant(f"pads{d}", [0, 0, 0, d, 0, 0, 0, 0]),
            helper.make_node("Slice", ["left", f"start{d}", f"stop{d}", "columns"], [f"left{d}"]),
            helper.make_node("Slice", ["right", "zero", f"width{d}", "columns"], [f"right{d}"]),
            helper.make_node("Mul", [f"left{d}", f"right{d}"], [f"product{d}"]),
            helper.make_node("ReduceMean", [f"product{d}", "one"], [f"mean{d}"]),
            helper.make_node("Pad", [f"mean{d}", f"pads{d}"], [f"slice{d}"]),
        ]
    nodes.append(helper.make_node("Concat", [f"slice{d}" for d in range(DISPARITIES)], ["volume"], axis=1))
    return _model(nodes, functions=[])


def median_ms(model: bytes, *, threads: int, use_native: bool) -> float:
    """Median time of one run."""
    left, right = np.random.default_rng(0).standard_normal((2, *SHAPE)).astype(np.float32)
    with open_session(model, threads=threads, use_native=use_native) as session:
        feeds = {"left": left, "right": right}
        session.run(feeds)
        times = []
        for _ in range(REPEATS):
            begin = time.perf_counter()
            session.run(feeds)
            times.append(time.perf_counter() - begin)
    return 1e3 * statistics.median(times)


def main(write: Callable[[str], object] = sys.stdout.write) -> None:
    """Prints one line a way of computing it."""
    threads = (1, os.cpu_count() or 1)
    write(f"[{', '.join(map(str, SHAPE))}], D = {DISPARITIES}: median ms with {threads[0]} / {threads[1]} threads\n")
    custom, chain = custom_node(), standard_chain()
    for name, model, use_native in (
        ("standard nodes", chain, False),
        ("function body", custom, False),
        ("native kernel", custom, True),
    ):
        times = [median_ms(model, threads=count, use_native=use_native) for count in threads]
        write(f"{name:15s} {times[0]:7.2f} / {times[1]:.2f}\n")


if __name__ == "__main__":
    main()
