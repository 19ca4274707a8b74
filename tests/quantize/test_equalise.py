"""Equalisation: the same network, channels of like range, and factors that stop where they must."""

from __future__ import annotations

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from calib.ranges import observe  # noqa: E402
from quantize.equalise import ChannelClasses, equalisable, equalise  # noqa: E402
from quantize.graph import name_nodes, tensor_shapes  # noqa: E402
from quantize.placement import place  # noqa: E402
from quantize.qdq import quantise_graph  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from runtime.session import open_session  # noqa: E402

SAME = 1e-4
"""Of the largest value: float32 sums of rescaled terms, a few layers deep."""
MIN_GAIN_DB = 6.0
"""The unlike channels keep a handful of levels without; with, two bits more at least: 12 dB are typical."""
GRID = 2.0**0.25
"""Factors lie on quarter octaves: one channel may end an eighth above, another an eighth below."""
CHANNELS = 8


def chain(middle: list[onnx.NodeProto], result: str) -> onnx.ModelProto:
    """Conv, ReLU, something, depthwise convolution, whose first channels are tiny and matter as much as the rest."""
    random = np.random.default_rng(5)
    size = np.geomspace(1e-3, 1, CHANNELS).astype(np.float32).reshape(-1, 1, 1, 1)
    constants = {
        "first.weight": random.normal(0, 1, (CHANNELS, 3, 3, 3)).astype(np.float32) * size,
        "first.bias": random.uniform(0, 1, CHANNELS).astype(np.float32) * size.reshape(-1),
        "cheap.weight": random.normal(0, 1, (CHANNELS, 1, 3, 3)).astype(np.float32) / size,
    }
    nodes = [
        helper.make_node("Conv", ["x", "first.weight", "first.bias"], ["first"], name="first", pads=[1] * 4),
        helper.make_node("Relu", ["first"], ["relu"], name="relu"),
        *middle,
        helper.make_node("Conv", [result, "cheap.weight"], ["y"], name="cheap", group=CHANNELS, pads=[1] * 4),
    ]
    graph = helper.make_graph(
        nodes,
        "chain",
        [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, 3, 8, 8])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


FEEDS = [{"x": np.random.default_rng(seed).normal(0, 1, (1, 3, 8, 8)).astype(np.float32)} for seed in range(6)]


def run(model, feeds):
    with open_session(model.SerializeToString(), name="toy") as session:
        return [np.concatenate([part.reshape(-1) for part in session.run(feed)]) for feed in feeds]


def made_alike(model, feeds, tensors, strength: float = 1.0):
    shapes = tensor_shapes(model)
    names = equalisable(model, shapes, tensors)
    if not names:
        return model
    seen = observe(model, lambda: feeds, tensors=(), channel_tensors=names)
    return equalise(model, shapes, seen.channels, strength=strength)


def test_without_extremes_nothing_changes() -> None:
    model = chain([], "relu")
    assert equalise(model, tensor_shapes(model), {}) == model


def test_strength_0_changes_nothing() -> None:
    model = chain([], "relu")
    assert made_alike(model, FEEDS, ["relu"], 0.0) == model


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_the_whole_toy_network_computes_the_same(toy_model, toy_feeds, strength: float) -> None:
    name_nodes(toy_model)
    tensors = [node.output[0] for node in toy_model.graph.node if node.op_type in ("Relu", "Concat", "AveragePool")]
    other = made_alike(toy_model, toy_feeds[:2], tensors, strength)
    assert other != toy_model
    for wanted, found in zip(run(toy_model, toy_feeds), run(other, toy_feeds), strict=True):
        assert np.abs(wanted - found).max() <= SAME * np.abs(wanted).max()


def test_channels_become_alike() -> None:
    model = chain([], "relu")
    other = made_alike(model, FEEDS, ["relu"])
    low, high = observe(other, lambda: FEEDS, tensors=(), channel_tensors=["relu"]).channels["relu"]
    smallest_factor = 2.0**-6  # the three channels below it stay small
    alike = high[high >= smallest_factor * high.max()]
    assert len(alike) >= CHANNELS - 3
    assert sorted(high)[-(CHANNELS - 3)] >= high.max() / GRID
    assert (low >= 0).all()


def test_8_bits_lose_less() -> None:
    model = chain([], "relu")
    recipe = recipe_for_target("x86-vnni")

    def snr_db(candidate) -> float:
        placement = place(candidate, recipe)
        seen = observe(candidate, lambda: FEEDS[:3], tensors=placement.observed)
        graph = quantise_graph(candidate, placement, recipe, ranges=seen.ranges("minmax"), channels={})
        wanted, found = (np.concatenate(run(item, FEEDS[3:])) for item in (model, graph.model))
        return float(10 * np.log10((wanted**2).sum() / ((wanted - found) ** 2).sum()))

    assert snr_db(made_alike(model, FEEDS[:3], ["relu"])) - snr_db(model) >= MIN_GAIN_DB


@pytest.mark.parametrize("operator", ["Sigmoid", "Softmax"])
def test_factors_do_not_pass_an_operator_that_they_change(operator: str) -> None:
    model = chain([helper.make_node(operator, ["relu"], ["other"], name="other")], "other")
    assert made_alike(model, FEEDS, ["relu", "other"]) == model


def test_a_correlation_keeps_the_channels_that_it_reads(toy_model) -> None:
    name_nodes(toy_model)
    classes = ChannelClasses(toy_model, tensor_shapes(toy_model))
    assert not classes.classes("fine.0").any()
    assert not classes.classes("block.conv2").any(), "an Add ties its operands"
    assert classes.classes("block.conv1").all()


def test_the_part_of_a_concatenation_that_is_free_moves_alone(toy_model) -> None:
    name_nodes(toy_model)
    classes = ChannelClasses(toy_model, tensor_shapes(toy_model)).classes("ghost")
    assert [bool(item) for item in classes] == [False] * 6 + [True] * 12


def test_a_weight_that_two_convolutions_share_stays() -> None:
    model = chain([helper.make_node("Conv", ["x", "first.weight"], ["again"], name="again", pads=[1] * 4)], "relu")
    model.graph.output.append(helper.make_tensor_value_info("again", TensorProto.FLOAT, None))
    assert made_alike(model, FEEDS, ["relu"]) == model
