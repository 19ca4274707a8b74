"""3D convolutions as 2D ones: the same numbers, the same names, and a reason where it is not done."""

from __future__ import annotations

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from quantize.volumes import MAX_DEPTH, flat_weight, flatten_volumes  # noqa: E402
from runtime.session import open_session  # noqa: E402

TOLERANCE = 1e-5
"""Relative to the largest value: float32 sums of some hundred products in another order."""


def volume_model(
    *, depth: int = 4, channels: int = 3, weight_name: str = "w0", relu: bool = True, **attributes
) -> onnx.ModelProto:
    """Two 3D convolutions, and the reshape to channels that reads them."""
    rng = np.random.default_rng(3)
    if "auto_pad" not in attributes:
        attributes = {"pads": [1] * 6, **attributes}
    constants = {
        "w0": rng.normal(0, 0.2, (5, channels // attributes.get("group", 1), 3, 3, 3)),
        "b0": rng.normal(0, 1, 5),
        "w1": rng.normal(0, 0.2, (2, 5, 3, 3, 3)),
    }
    between = "r" if relu else "c0"
    nodes = [
        helper.make_node("Conv", ["x", weight_name, "b0"], ["c0"], name="first", **attributes),
        *([helper.make_node("Relu", ["c0"], ["r"], name="relu")] if relu else []),
        helper.make_node("Conv", [between, "w1"], ["c1"], name="second", pads=[1] * 6),
        helper.make_node("Reshape", ["c1", "shape"], ["y"], name="to_channels"),
    ]
    strides = attributes.get("strides", [1, 1, 1])
    planes, rows, columns = (-(-size // step) for size, step in zip((depth, 5, 7), strides, strict=True))
    initializers = [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()]
    initializers.append(numpy_helper.from_array(np.array([1, 2 * planes, rows, columns], np.int64), "shape"))
    inputs = [helper.make_tensor_value_info("x", TensorProto.FLOAT, [1, channels, depth, 5, 7])]
    if weight_name not in constants:
        inputs.append(helper.make_tensor_value_info(weight_name, TensorProto.FLOAT, [5, channels, 3, 3, 3]))
    graph = helper.make_graph(
        nodes,
        "volume",
        inputs,
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, [1, 2 * planes, rows, columns])],
        initializers,
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def outputs(model: onnx.ModelProto) -> np.ndarray:
    shape = [dim.dim_value for dim in model.graph.input[0].type.tensor_type.shape.dim]
    with open_session(model.SerializeToString()) as session:
        return session.run({"x": np.random.default_rng(4).normal(0, 1, shape).astype(np.float32)})[0]


def test_a_graph_without_volumes_is_given_back(toy_model) -> None:
    flat = flatten_volumes(toy_model).model
    found = flatten_volumes(flat)
    assert found.model is flat
    assert found.flattened == ()
    assert found.kept == {}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"depth": 1},  # the outer taps read padding alone
        {"depth": MAX_DEPTH, "channels": 1},
        {"relu": False},
        {"strides": [2, 1, 1]},  # fewer planes come out
        {"strides": [1, 2, 2]},
        {"dilations": [2, 1, 1], "pads": [2, 1, 1, 2, 1, 1]},
        {"dilations": [1, 2, 2], "pads": [1, 2, 2, 1, 2, 2]},
    ],
)
def test_the_numbers_stay(options) -> None:
    model = volume_model(**options)
    found = flatten_volumes(model)
    assert found.flattened == ("first", "second")
    onnx.checker.check_model(found.model, full_check=True)
    before, after = outputs(model), outputs(found.model)
    assert np.abs(before - after).max() < TOLERANCE * np.abs(before).max()


def test_between_two_of_them_nothing_is_reshaped() -> None:
    nodes = flatten_volumes(volume_model()).model.graph.node
    assert [node.op_type for node in nodes] == ["Reshape", "Conv", "Relu", "Conv", "Reshape"]
    assert [node.name for node in nodes if node.op_type == "Conv"] == ["first", "second"]


def test_who_reads_the_volume_itself_still_gets_it() -> None:
    model = volume_model()
    model.graph.output.append(helper.make_tensor_value_info("r", TensorProto.FLOAT, [1, 5, 4, 5, 7]))
    found = flatten_volumes(model).model
    feed = {"x": np.random.default_rng(4).normal(0, 1, (1, 3, 4, 5, 7)).astype(np.float32)}
    with open_session(model.SerializeToString()) as one, open_session(found.SerializeToString()) as other:
        for before, after in zip(one.run(feed), other.run(feed), strict=True):
            assert before.shape == after.shape
            assert np.abs(before - after).max() < TOLERANCE * np.abs(before).max()


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"depth": MAX_DEPTH + 1}, "planes"),
        ({"group": 5, "channels": 15}, "groups"),
        ({"auto_pad": "SAME_UPPER"}, "padding"),
        ({"weight_name": "given"}, "computed"),
    ],
)
def test_where_it_is_not_done_the_reason_is_named(options, reason) -> None:
    found = flatten_volumes(volume_model(**options))
    assert "first" not in found.flattened
    assert reason in found.kept["first"]


def test_a_kernel_deeper_than_the_volume_keeps_the_taps_that_meet_it() -> None:
    weight = np.arange(1, 4, dtype=np.float32).reshape(1, 1, 3, 1, 1)
    flat = flat_weight(weight, 2, 2, stride=1, dilation=1, pad=1)
    assert flat[:, :, 0, 0].tolist() == [[2, 3], [1, 2]]
