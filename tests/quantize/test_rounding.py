"""Rounding by what weights do to sums: the windows, the rule on its own, and an INT8 graph that errs less."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from calib.ranges import GROUP_BYTES, observe  # noqa: E402
from quantize.adjustments import adjust, adjusted_ways, variants  # noqa: E402
from quantize.errors import QuantizeError  # noqa: E402
from quantize.output_error import OutputError  # noqa: E402
from quantize.prepare import Prepared, prepare_model  # noqa: E402
from quantize.qdq import nearest_levels  # noqa: E402
from quantize.qparams import largest_level, quantize_weight, weight_scales  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from quantize.rounding import round_by_moments, rounded_weights  # noqa: E402
from quantize.static import build  # noqa: E402
from quantize.window_moments import MomentBlock, sampled_windows, window_of  # noqa: E402
from runtime.contracts.manifest import open_model_directory  # noqa: E402
from runtime.session import open_session  # noqa: E402

CALIBRATING, HELD_OUT = slice(0, 6), slice(6, 8)
SAME_SUM = 1e-4
"""Two orders of adding float32 products of order 1."""
MOST_OUTPUT_ERROR = 0.8
"""Of the nearest levels' at the outputs of the toy network, 7-bit weights, frames that did not calibrate."""


@pytest.fixture
def prepared(toy_directory) -> Prepared:
    return prepare_model(open_model_directory(toy_directory), recipe_for_target("generic"))


@pytest.fixture
def observation(prepared, toy_feeds):
    placement = prepared.placement
    return observe(
        prepared.model,
        lambda: toy_feeds[CALIBRATING],
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
    )


@pytest.mark.parametrize(
    ("attributes", "shape"),
    [
        ({}, (6, 4, 1, 1)),
        ({"pads": [1, 1, 1, 1], "strides": [2, 2]}, (6, 4, 3, 3)),
        ({"pads": [2, 1, 0, 3], "dilations": [2, 1], "strides": [1, 2]}, (6, 4, 3, 2)),
        ({"pads": [1, 1, 1, 1], "group": 2}, (6, 2, 3, 3)),
    ],
)
def test_windows_are_those_of_the_convolution(attributes, shape) -> None:
    random = np.random.default_rng(0)
    values = random.standard_normal((2, 4, 9, 11)).astype(np.float32)
    weight = random.standard_normal(shape).astype(np.float32)
    node = onnx.helper.make_node("Conv", ["x", "w"], ["y"], name="y", **attributes)
    graph = onnx.helper.make_graph(
        [node],
        "convolution",
        [onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, values.shape)],
        [onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, None)],
        [onnx.numpy_helper.from_array(weight, "w")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    with open_session(model.SerializeToString()) as session:
        (wanted,) = session.run({"x": values})
    groups = attributes.get("group", 1)
    windows = sampled_windows(values, window_of(node, shape), np.random.default_rng(0), count=wanted.size)
    by_group = weight.reshape(groups, shape[0] // groups, -1)
    found = np.einsum("pgk,gmk->pgm", windows, by_group).reshape(len(windows), -1)
    np.testing.assert_allclose(found, wanted.transpose(0, 2, 3, 1).reshape(len(found), -1), atol=SAME_SUM)


def related_inputs(count: int) -> np.ndarray:
    """(count, 24) inputs with a mean, of which any few tell the others."""
    random = np.random.default_rng(1)
    return np.asarray(1 + random.standard_normal((count, 6)) @ random.standard_normal((6, 24)))


def whole(moments: np.ndarray) -> list[MomentBlock]:
    return [MomentBlock(slice(None), slice(None), moments)]


@pytest.mark.parametrize("bits", [7, 8])
def test_sums_of_related_inputs_stay_closer(bits: int) -> None:
    weight = np.random.default_rng(2).standard_normal((16, 24)).astype(np.float32)
    scales = weight_scales(weight, bits=bits, per_channel=True)
    seen, other = np.split(related_inputs(400), 2)
    levels = round_by_moments(weight, scales, whole(seen.T @ seen / len(seen)), bits=bits)
    nearest = quantize_weight(weight, scales, bits=bits)
    errors = [np.square(other @ (item * scales[:, None] - weight).T).mean() for item in (levels, nearest)]
    assert errors[0] < errors[1] / 4
    assert np.abs(levels).max() <= largest_level(bits)
    assert np.abs(levels * scales[:, None] - weight).max() < 8 * scales.max()


def test_no_output_channel_gets_worse_on_what_was_seen() -> None:
    weight = np.random.default_rng(3).standard_normal((64, 24)).astype(np.float32)
    scales = weight_scales(weight, bits=7, per_channel=True)
    seen = related_inputs(30)
    noise = 0.01 * np.square(seen).mean()
    levels = round_by_moments(weight, scales, whole(seen.T @ seen / len(seen)), bits=7)
    moments = seen.T @ seen / len(seen) + noise * np.eye(24)
    steps = weight.astype(np.float64) / scales.astype(np.float64)[:, None]
    by, nearest = (item - steps for item in (levels, quantize_weight(weight, scales, bits=7)))
    assert np.all(
        np.einsum("mk,kl,ml->m", by, moments, by) <= np.einsum("mk,kl,ml->m", nearest, moments, nearest) + 1e-9
    )


@pytest.mark.parametrize("moments", [np.eye(24), np.zeros((24, 24))], ids=["unrelated", "nothing"])
def test_unrelated_inputs_leave_the_nearest_levels(moments: np.ndarray) -> None:
    weight = np.random.default_rng(4).standard_normal((5, 24)).astype(np.float32)
    scales = weight_scales(weight, bits=8, per_channel=True)
    levels = round_by_moments(weight, scales, whole(moments), bits=8)
    np.testing.assert_array_equal(levels, quantize_weight(weight, scales, bits=8))


def test_a_network_errs_less_on_other_frames(prepared, observation, toy_feeds) -> None:
    ranges = observation.ranges("minmax")
    levels = rounded_weights(prepared, ranges, lambda: toy_feeds[CALIBRATING])
    distance = OutputError(prepared.model, toy_feeds[HELD_OUT])
    rounded, nearest = (distance.of(build(prepared, observation, ranges, levels=item).model) for item in (levels, None))
    assert rounded < MOST_OUTPUT_ERROR * nearest


def test_a_layer_given_back_and_one_without_levels_are_written_as_before(prepared, observation, toy_feeds) -> None:
    ranges = observation.ranges("minmax")
    levels = rounded_weights(prepared, ranges, lambda: toy_feeds[:1])
    kept = {name: item for name, item in levels.items() if name != "ghost.cheap"}
    assert (
        build(prepared, observation, ranges, given_back=["ghost.cheap"], levels=levels).model
        == build(prepared, observation, ranges, given_back=["ghost.cheap"], levels=kept).model
    )


def test_where_memory_holds_one_convolution_at_a_time_the_levels_are_the_same(prepared, observation, toy_feeds) -> None:
    ranges = observation.ranges("minmax")
    stages: set[str] = set()
    large = dict.fromkeys([node.input[0] for node in prepared.model.graph.node if node.op_type == "Conv"], GROUP_BYTES)
    one_by_one = rounded_weights(
        prepared,
        ranges,
        lambda: toy_feeds[:2],
        bytes_of=large,
        progress=lambda stage, done, total: stages.add(stage),
    )
    at_once = rounded_weights(prepared, ranges, lambda: toy_feeds[:2])
    assert len(stages) > 2  # parts, and rounding itself
    assert list(one_by_one) == list(at_once)
    for name, levels in at_once.items():
        np.testing.assert_array_equal(one_by_one[name], levels)


def test_nearest_levels_given_are_those_that_a_build_finds_itself(prepared, observation) -> None:
    ranges = observation.ranges("minmax")
    levels = nearest_levels(prepared.model, prepared.placement, prepared.recipe)
    assert build(prepared, observation, ranges, levels=levels).model == build(prepared, observation, ranges).model


def test_no_frames_are_refused(prepared, observation) -> None:
    with pytest.raises(QuantizeError, match="rounding: found no frames"):
        rounded_weights(prepared, observation.ranges("minmax"), list)


def test_variants_begin_with_the_recipe_itself(prepared) -> None:
    found = variants(prepared)
    assert list(found) == [
        "weights rounded by what they do",
        "weights rounded by what they do, biases corrected",
        "weights to the nearest level",
        "weights to the nearest level, biases corrected",
    ]
    assert next(iter(found.values())).recipe == prepared.recipe
    assert {item.recipe.adjustments: item for item in found.values()}.keys() == found.keys()


def test_all_ways_round_once(prepared, observation, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(
        "quantize.adjustments.roundings", lambda variant, *_, **__: asked.append(variant.recipe.output_rounding) or {}
    )
    monkeypatch.setattr("quantize.adjustments.corrections", lambda variant, *_, **__: {"bias": np.ones(1)})
    given = (prepared, None, observation.ranges("minmax"), None)
    assert list(adjusted_ways(*given, every=True)) == list(variants(prepared))
    assert asked == [True, False]
    ((name, way),) = adjusted_ways(*given, every=False).items()
    assert way.prepared.recipe == prepared.recipe and name == prepared.recipe.adjustments


def test_a_recipe_without_adjustments_looks_at_no_frame(prepared, observation) -> None:
    plain = dataclasses.replace(prepared.recipe, output_rounding=False)
    nothing = adjust(dataclasses.replace(prepared, recipe=plain), None, observation.ranges("minmax"), None)
    assert nothing.levels == {} and nothing.shifts == {}
