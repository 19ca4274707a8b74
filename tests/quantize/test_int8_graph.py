"""The INT8 graph: what ONNX Runtime makes of it, and how far it is from the float one."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from calib.ranges import observe  # noqa: E402
from quantize.errors import QuantizeError  # noqa: E402
from quantize.graph import GraphIndex, multiply_adds, name_nodes, prune, tensor_shapes  # noqa: E402
from quantize.pixels import fold_pixels  # noqa: E402
from quantize.placement import place  # noqa: E402
from quantize.qdq import quantise_graph  # noqa: E402
from quantize.recipe import load_recipes, recipe_for_target  # noqa: E402
from quantize.volumes import flatten_volumes  # noqa: E402
from runtime.contracts.correlation import QLINEAR_STEREO_CORRELATION, STEREO_CORRELATION  # noqa: E402
from runtime.native.library import library_path  # noqa: E402
from runtime.profile import int8_share, profile_model  # noqa: E402
from runtime.session import open_session  # noqa: E402

MIN_OUTPUT_SNR_DB = 25.0
"""One rounding to 8 bits leaves about 45 dB of a signal that fills its range, 10 dB less of one with rare peaks; a
dozen layers in a row add as many noises, 11 dB. A wrong scale or zero point anywhere leaves less than 10 dB."""
MIN_OUTPUT_SNR_DB_7_BITS = 22.0
"""With one bit less, in weights or, after a ReLU, in symmetric activations."""
CALIBRATION = slice(0, 6)
HELD_OUT = slice(6, 8)


def quantised(model, recipe, feeds, *, excluded=()):
    """Float model with pixels folded and volumes flattened, placement, INT8 graph."""
    name_nodes(model)
    folded = fold_pixels(model).model if recipe.fold_pixels else model
    folded = flatten_volumes(folded).model if recipe.flatten_volumes else folded
    full = place(folded, recipe)
    seen = observe(folded, lambda: feeds[CALIBRATION], tensors=full.observed, channel_tensors=full.observed_channels)
    placement = place(folded, recipe, excluded) if excluded else full
    ranges = seen.ranges("minmax")
    ranges |= {name: ranges[full.root_of[name]] for name in placement.observed}
    graph = quantise_graph(folded, placement, recipe, ranges=ranges, channels=seen.channels)
    return folded, placement, graph


def output_snr_db(float_model, int8_model, feeds) -> list[float]:
    """Of each output over the held-out feeds."""
    with (
        open_session(float_model.SerializeToString()) as before,
        open_session(int8_model.SerializeToString()) as after,
    ):
        pairs = [(before.run(feed), after.run(feed)) for feed in feeds[HELD_OUT]]
    found = []
    for position in range(len(pairs[0][0])):
        signal = np.stack([a[position] for a, _ in pairs]).astype(np.float64)
        noise = signal - np.stack([b[position] for _, b in pairs])
        found.append(float(10 * np.log10((signal**2).sum() / (noise**2).sum())))
    return found


@pytest.mark.parametrize("target", sorted(load_recipes()))
def test_every_recipe_gives_a_valid_model_close_to_float(target, toy_model, toy_feeds) -> None:
    recipe = recipe_for_target(target)
    _, _, graph = quantised(toy_model, recipe, toy_feeds)
    onnx.checker.check_model(graph.model, full_check=True)
    all_bits = recipe.weight_bits == 8 and not recipe.activation_symmetric
    least = MIN_OUTPUT_SNR_DB if all_bits else MIN_OUTPUT_SNR_DB_7_BITS
    assert min(output_snr_db(toy_model, graph.model, toy_feeds)) > least


@pytest.mark.parametrize("target", ["x86-vnni", "generic", "arm64", "x86-avx2"])
def test_onnx_runtime_fuses_all_of_it(target, toy_model, toy_feeds) -> None:
    recipe = recipe_for_target(target)
    _, _, graph = quantised(toy_model, recipe, toy_feeds)
    ran = Counter(node.operator for node in profile_model(graph.model.SerializeToString(), toy_feeds[:1]))
    convolutions = sum(node.op_type == "Conv" for node in toy_model.graph.node)
    assert ran["QLinearConv"] == convolutions - 2
    assert ran["MatMulInteger"] == 2  # one an output of the network
    assert ran["Add"] == 2  # the bias to each one's sums
    assert ran["QLinearAdd"] == 1
    assert ran["QLinearAveragePool"] == 1
    for float_operator in ("Conv", "FusedConv", "Relu", "AveragePool", "QuantizeLinear", "DequantizeLinear"):
        assert ran[float_operator] == 0, float_operator


@pytest.mark.skipif(library_path() is None, reason="the native library is not built")
def test_the_correlation_runs_in_8_bits_and_counts(toy_model, toy_feeds) -> None:
    _, _, graph = quantised(toy_model, recipe_for_target("x86-vnni"), toy_feeds)
    nodes = profile_model(graph.model.SerializeToString(), toy_feeds[:1])
    kinds = Counter(node.operator for node in nodes)
    assert kinds[QLINEAR_STEREO_CORRELATION] == 1
    assert kinds[STEREO_CORRELATION] == 0
    assert int8_share(nodes) == 1.0
    folded = fold_pixels(toy_model).model
    shapes = tensor_shapes(folded)
    assert sum(node.multiply_adds for node in nodes) == sum(multiply_adds(n, shapes) for n in folded.graph.node)
    volume = next(node for node in nodes if node.operator == QLINEAR_STEREO_CORRELATION)
    assert volume.multiply_adds == 6 * 8 * 8 * 16  # D, C, H, W


def test_it_runs_the_same_without_the_library(toy_model, toy_feeds) -> None:
    _, _, graph = quantised(toy_model, recipe_for_target("x86-vnni"), toy_feeds)
    content = graph.model.SerializeToString()
    with open_session(content) as native, open_session(content, use_native=False) as plain:
        for a, b in zip(native.run(toy_feeds[0]), plain.run(toy_feeds[0]), strict=True):
            np.testing.assert_array_equal(a, b)


def test_pixels_enter_as_bytes(toy_model, toy_feeds) -> None:
    _, _, graph = quantised(toy_model, recipe_for_target("x86-vnni"), toy_feeds)
    inputs = {"left", "right"}
    readers = {node.op_type for node in graph.model.graph.node if inputs & set(node.input)}
    assert readers == {"Concat"}


def test_weights_are_stored_as_bytes_and_floats_are_gone(toy_model, toy_feeds) -> None:
    _, _, graph = quantised(toy_model, recipe_for_target("x86-vnni"), toy_feeds)
    stored = {tensor.name: tensor for tensor in graph.model.graph.initializer}
    weights = [tensor for name, tensor in stored.items() if name.endswith((".weight_q", ".matrix_q"))]
    assert len(weights) == sum(node.op_type == "Conv" for node in toy_model.graph.node)
    assert all(tensor.data_type == onnx.TensorProto.INT8 for tensor in weights)
    assert not any(len(t.dims) > 1 and t.data_type == onnx.TensorProto.FLOAT for t in stored.values())
    assert {function.name for function in graph.model.functions} == {QLINEAR_STEREO_CORRELATION}


def test_values_that_only_move_keep_their_scale(toy_model, toy_feeds) -> None:
    _, placement, graph = quantised(toy_model, recipe_for_target("x86-vnni"), toy_feeds)
    assert placement.root_of["pool"] == "stem/relu"
    assert placement.root_of["fine.0"] == placement.root_of["fine.1"] == "block.add/relu"
    assert placement.root_of["stacked"] == "reduce/relu"  # slices, pads and joins of one tensor
    assert placement.root_of["ghost"] == "ghost"  # a join of different ones has a range of its own
    assert graph.tensors["stacked"][1] == graph.tensors["reduce/relu"][1]


def test_a_column_of_the_output_has_its_own_step(toy_model, toy_feeds) -> None:
    """A column a hundred times smaller than its neighbours would vanish in one step for all."""
    recipe = dataclasses.replace(recipe_for_target("x86-vnni"), exact_outputs=False)
    weights = {tensor.name: tensor for tensor in toy_model.graph.initializer}
    for part in ("weight", "bias"):
        tensor = weights[f"box_deltas.last.{part}"]
        values = onnx.numpy_helper.to_array(tensor).copy()
        values[6::12] *= 0.01
        tensor.CopyFrom(onnx.numpy_helper.from_array(values, tensor.name))
    feed = toy_feeds[HELD_OUT][0]
    snr = {}
    for name, variant in (("columns", recipe), ("one", dataclasses.replace(recipe, column_outputs=False))):
        copy = onnx.ModelProto.FromString(toy_model.SerializeToString())
        _, _, graph = quantised(copy, variant, toy_feeds)
        with (
            open_session(toy_model.SerializeToString()) as before,
            open_session(graph.model.SerializeToString()) as after,
        ):
            signal, other = before.run(feed)[1][..., 6], after.run(feed)[1][..., 6]
        snr[name] = 10 * np.log10((signal**2).sum() / ((signal - other) ** 2).sum())
    assert snr["columns"] > MIN_OUTPUT_SNR_DB - 5  # one column of twelve scatters more than all together
    assert snr["one"] < 10


@pytest.mark.parametrize("symmetric", [False, True])
def test_columns_of_signed_levels(toy_model, toy_feeds, symmetric) -> None:
    recipe = dataclasses.replace(
        recipe_for_target("x86-vnni"),
        activation_type="int8",
        activation_symmetric=symmetric,
        fold_pixels=False,
        exact_outputs=False,
    )
    _, _, graph = quantised(toy_model, recipe, toy_feeds)
    onnx.checker.check_model(graph.model, full_check=True)
    stored = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.model.graph.initializer}
    columns = [values for name, values in stored.items() if name.endswith("_column_zero_point")]
    assert len(columns) == 2
    for values in columns:
        assert values.dtype == np.int8
        assert bool(np.any(values)) is not symmetric
    least = MIN_OUTPUT_SNR_DB_7_BITS if symmetric else MIN_OUTPUT_SNR_DB
    assert min(output_snr_db(toy_model, graph.model, toy_feeds)) > least


def test_layers_given_back_run_in_float(toy_model, toy_feeds) -> None:
    recipe = recipe_for_target("x86-vnni")
    excluded = ["stereo", "volume", "box_deltas.last", "stem"]
    folded, placement, graph = quantised(toy_model, recipe, toy_feeds, excluded=excluded)
    assert all(placement.kept_float[name] == "given back to float" for name in excluded)
    onnx.checker.check_model(graph.model, full_check=True)
    by_name = {node.name: node for node in graph.model.graph.node}
    assert by_name["volume"].op_type == STEREO_CORRELATION
    assert min(output_snr_db(toy_model, graph.model, toy_feeds)) > MIN_OUTPUT_SNR_DB
    everything = [node.name for node in folded.graph.node if node.op_type in ("Conv", STEREO_CORRELATION)]
    placement = place(folded, recipe, everything)
    assert not placement.nodes, "blends and moves alone are not worth 8 bits"


def test_a_missing_range_is_an_error(toy_model, toy_feeds) -> None:
    name_nodes(toy_model)
    folded = fold_pixels(toy_model).model
    recipe = recipe_for_target("x86-vnni")
    with pytest.raises(QuantizeError, match="found no range"):
        quantise_graph(folded, place(folded, recipe), recipe, ranges={}, channels={})


def test_multiply_adds_and_shapes(toy_model) -> None:
    shapes = tensor_shapes(toy_model)
    assert shapes["volume"] == (1, 6, 8, 16)
    assert shapes["ghost"] == (1, 18, 8, 16)
    by_name = {node.name: node for node in toy_model.graph.node}
    assert multiply_adds(by_name["stem"], shapes) == 2 * 8 * 16 * 32 * 3 * 49
    assert multiply_adds(by_name["ghost.cheap"], shapes) == 6 * 8 * 16 * 9
    assert multiply_adds(by_name["mix"], shapes) == 4 * 3 * 2 * 4 * 8 * 27
    assert multiply_adds(by_name["volume"], shapes) == 6 * 8 * 8 * 16
    assert multiply_adds(by_name["ghost"], shapes) == 0


def test_pruning_drops_what_no_output_needs(toy_model) -> None:
    before = len(toy_model.graph.node)
    toy_model.graph.node.append(onnx.helper.make_node("Relu", ["stem"], ["nobody"], name="nobody"))
    toy_model.graph.initializer.append(onnx.numpy_helper.from_array(np.zeros(1), "unused"))
    prune(toy_model)
    index = GraphIndex(toy_model)
    assert len(toy_model.graph.node) == before
    assert "unused" not in index.initializers
    assert [function.name for function in toy_model.functions] == [STEREO_CORRELATION]
