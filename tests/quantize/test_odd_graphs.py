"""Graphs that are not like the detector's: the INT8 form must stay right, or leave the odd part in float."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from calib.ranges import observe  # noqa: E402
from quantize.graph import name_nodes  # noqa: E402
from quantize.pixels import fold_pixels  # noqa: E402
from quantize.placement import place  # noqa: E402
from quantize.qdq import quantise_graph  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from runtime.session import open_session  # noqa: E402

MIN_SNR_DB = 28.0
"""Two or three roundings to 8 bits of signals that fill their range: 45 dB each, rare peaks cost 10."""
RANDOM = np.random.default_rng(5)
WEIGHTS = {
    "w1": RANDOM.normal(0, 0.4, (6, 3, 3, 3)),
    "w2": RANDOM.normal(0, 0.3, (4, 6, 3, 3)),
    "one_by_one": RANDOM.normal(0, 0.4, (6, 6, 1, 1)),
}
FEEDS = [{"x": RANDOM.normal(0, 1, (1, 3, 8, 8)).astype(np.float32)} for _ in range(4)]
PADDED = {"pads": [1, 1, 1, 1]}


def graph_of(nodes, outputs, constants=WEIGHTS) -> onnx.ModelProto:
    graph = helper.make_graph(
        nodes,
        "odd",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["b", "c", "h", "w"]) for name in outputs],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def quantised(model, feeds=FEEDS) -> tuple[onnx.ModelProto, dict[str, float]]:
    """INT8 model and signal-to-noise of each output."""
    name_nodes(model)
    recipe = recipe_for_target("x86-vnni")
    folded = fold_pixels(model).model
    placement = place(folded, recipe)
    seen = observe(folded, lambda: feeds, tensors=placement.observed, channel_tensors=placement.observed_channels)
    int8 = quantise_graph(folded, placement, recipe, ranges=seen.ranges("minmax"), channels=seen.channels).model
    onnx.checker.check_model(int8, full_check=True)
    with open_session(model.SerializeToString()) as before, open_session(int8.SerializeToString()) as after:
        names = [item.name for item in before.outputs]
        assert [item.name for item in after.outputs] == names
        found = {}
        pairs = [(before.run(feed), after.run(feed)) for feed in feeds]
        for position, name in enumerate(names):
            signal = np.stack([a[position] for a, _ in pairs]).astype(np.float64)
            noise = signal - np.stack([b[position] for _, b in pairs])
            found[name] = float(10 * np.log10((signal**2).sum() / max((noise**2).sum(), 1e-12)))
    return int8, found


def kinds(model: onnx.ModelProto) -> Counter[str]:
    return Counter(node.op_type for node in model.graph.node)


def test_float_input_and_an_output_that_is_read_on() -> None:
    nodes = [
        helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
        helper.make_node("Relu", ["a"], ["y"]),
        helper.make_node("Conv", ["y", "w2"], ["z"], **PADDED),
    ]
    model, snr = quantised(graph_of(nodes, ["y", "z"]))
    assert min(snr.values()) > MIN_SNR_DB
    assert {name for node in model.graph.node for name in node.output} >= {"y", "z"}


def test_a_tensor_that_is_read_in_float_and_in_8_bits() -> None:
    nodes = [
        helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
        helper.make_node("Sigmoid", ["a"], ["gate"]),
        helper.make_node("Mul", ["a", "gate"], ["b"]),
        helper.make_node("Conv", ["b", "w2"], ["y"], **PADDED),
    ]
    model, snr = quantised(graph_of(nodes, ["y"]))
    assert snr["y"] > MIN_SNR_DB
    assert kinds(model)["Sigmoid"] == 1


def test_a_relu_behind_two_readers_does_not_vanish() -> None:
    """The convolution's own values are needed, too, so its ReLU must not be taken into it."""
    nodes = [
        helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Conv", ["a", "one_by_one"], ["c"]),
        helper.make_node("Add", ["b", "c"], ["d"]),
        helper.make_node("Conv", ["d", "w2"], ["y"], **PADDED),
    ]
    _, snr = quantised(graph_of(nodes, ["y"]))
    assert snr["y"] > MIN_SNR_DB


def test_two_relus_in_a_row_are_one() -> None:
    nodes = [
        helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
        helper.make_node("Relu", ["a"], ["b"]),
        helper.make_node("Relu", ["b"], ["c"]),
        helper.make_node("Conv", ["c", "w2"], ["y"], **PADDED),
    ]
    model, snr = quantised(graph_of(nodes, ["y"]))
    assert snr["y"] > MIN_SNR_DB
    assert kinds(model)["Relu"] == 1


def test_two_convolutions_with_one_weight() -> None:
    """Their inputs have other scales, so each has a bias of its own."""
    constants = {**WEIGHTS, "bias": RANDOM.normal(0, 1, 6), "ten": np.full((1, 3, 1, 1), 10.0)}
    nodes = [
        helper.make_node("Mul", ["x", "ten"], ["big"]),
        helper.make_node("Conv", ["x", "w1", "bias"], ["a"], **PADDED),
        helper.make_node("Conv", ["big", "w1", "bias"], ["b"], **PADDED),
        helper.make_node("Concat", ["a", "b"], ["c"], axis=0),
        helper.make_node("Conv", ["c", "w2"], ["y"], **PADDED),
    ]
    _, snr = quantised(graph_of(nodes, ["y"], constants))
    assert snr["y"] > MIN_SNR_DB


def test_padding_with_zero_in_a_signed_tensor_pads_with_the_zero_point() -> None:
    constants = {name: WEIGHTS[name] for name in ("w1", "w2")}
    model = graph_of(
        [
            helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
            helper.make_node("Pad", ["a", "pads"], ["b"]),
            helper.make_node("Conv", ["b", "w2"], ["y"]),
        ],
        ["y"],
        constants,
    )
    model.graph.initializer.append(numpy_helper.from_array(np.array([0, 0, 2, 0, 0, 0, 0, 3], np.int64), "pads"))
    int8, snr = quantised(model)
    assert snr["y"] > MIN_SNR_DB
    pad = next(node for node in int8.graph.node if node.op_type == "Pad")
    assert pad.input[0].endswith("_q")


@pytest.mark.parametrize("value", [1.0, -3.0])
def test_padding_with_something_else_stays_float(value: float) -> None:
    model = graph_of(
        [
            helper.make_node("Conv", ["x", "w1"], ["a"], **PADDED),
            helper.make_node("Pad", ["a", "pads", "value"], ["b"]),
            helper.make_node("Conv", ["b", "w2"], ["y"]),
        ],
        ["y"],
        {**WEIGHTS, "value": np.array(value)},
    )
    model.graph.initializer.append(numpy_helper.from_array(np.array([0, 0, 2, 0, 0, 0, 0, 3], np.int64), "pads"))
    int8, snr = quantised(model)
    assert snr["y"] > MIN_SNR_DB
    pad = next(node for node in int8.graph.node if node.op_type == "Pad")
    assert not pad.input[0].endswith("_q")


def test_a_channel_without_weights_keeps_its_bias() -> None:
    weight = WEIGHTS["w1"].copy()
    weight[2] = 0
    constants = {"w1": weight, "w2": WEIGHTS["w2"], "bias": np.array([0.1, 0, 7.5, -0.2, 0, 1])}
    nodes = [
        helper.make_node("Conv", ["x", "w1", "bias"], ["a"], **PADDED),
        helper.make_node("Conv", ["a", "w2"], ["y"], **PADDED),
    ]
    _, snr = quantised(graph_of(nodes, ["y"], constants))
    assert snr["y"] > MIN_SNR_DB
