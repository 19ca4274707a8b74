"""Normalisation moves into the stem: exact inside the image, close at its padded border."""

from __future__ import annotations

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from quantize.pixels import fold_pixels  # noqa: E402
from runtime.session import open_session  # noqa: E402

INSIDE_TOLERANCE = 2e-5
"""Float32 sums of 147 products of size 1 in another order, relative to the largest output."""
BORDER_TOLERANCE = 0.15
"""Relative: padding counts as grey instead of the mean colour, 0.13 standard deviations apart."""
PADDED_ROWS = 2
"""A 7x7 stem of stride 2 and padding 3 sees padding in its outermost two rows and columns."""


def run(model: onnx.ModelProto, feed: dict[str, np.ndarray], output: str) -> np.ndarray:
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    del copy.graph.output[:]
    copy.graph.output.append(helper.make_tensor_value_info(output, TensorProto.FLOAT, None))
    with open_session(copy.SerializeToString()) as session:
        return session.run(feed)[0]


def test_the_stem_reads_pixels_and_computes_the_same(toy_model, toy_feeds) -> None:
    folding = fold_pixels(toy_model)
    assert folding.reason is None
    assert folding.folded == ("stem",)
    kinds = [node.op_type for node in folding.model.graph.node]
    assert "Cast" not in kinds
    assert kinds.count("DequantizeLinear") == 1
    onnx.checker.check_model(folding.model, full_check=True)
    before, after = (run(model, toy_feeds[0], "stem") for model in (toy_model, folding.model))
    error = np.abs(before - after) / np.abs(before).max()
    inside = error[..., PADDED_ROWS:-PADDED_ROWS, PADDED_ROWS:-PADDED_ROWS]
    assert inside.max() < INSIDE_TOLERANCE
    assert error.max() < BORDER_TOLERANCE


def test_the_model_given_is_left_alone(toy_model, toy_bytes) -> None:
    fold_pixels(toy_model)
    assert toy_model.SerializeToString() == toy_bytes


def single_view(nodes, constants, *, kind=TensorProto.UINT8) -> onnx.ModelProto:
    graph = helper.make_graph(
        nodes,
        "view",
        [helper.make_tensor_value_info("left", kind, [1, 3, 8, 8])],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(np.asarray(value, np.float32), name) for name, value in constants.items()],
    )
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


CAST = helper.make_node("Cast", ["left"], ["x"], name="cast", to=TensorProto.FLOAT)
WEIGHT = np.random.default_rng(0).normal(0, 1, (4, 3, 3, 3))


def test_division_and_subtraction_fold_too() -> None:
    nodes = [
        CAST,
        helper.make_node("Div", ["x", "white"], ["share"], name="div"),
        helper.make_node("Sub", ["share", "mean"], ["centred"], name="sub"),
        helper.make_node("Conv", ["centred", "weight"], ["y"], name="conv"),
    ]
    constants = {"white": 255.0, "mean": np.array([0.4, 0.5, 0.6]).reshape(3, 1, 1), "weight": WEIGHT}
    model = single_view(nodes, constants)
    folding = fold_pixels(model)
    assert folding.folded == ("conv",)
    feed = {"left": np.random.default_rng(1).integers(0, 256, (1, 3, 8, 8)).astype(np.uint8)}
    before, after = run(model, feed, "y"), run(folding.model, feed, "y")
    assert np.abs(before - after).max() < INSIDE_TOLERANCE * np.abs(before).max()


@pytest.mark.parametrize(
    ("nodes", "kind", "said"),
    [
        ([helper.make_node("Conv", ["left", "weight"], ["y"], name="conv")], TensorProto.FLOAT, "no input is uint8"),
        ([CAST, helper.make_node("Relu", ["x"], ["y"], name="relu")], TensorProto.UINT8, "read by Relu"),
        (
            [
                CAST,
                helper.make_node("Conv", ["x", "weight"], ["z"], name="conv"),
                helper.make_node("GlobalAveragePool", ["x"], ["m"], name="pool"),
                helper.make_node("Concat", ["z", "m"], ["y"], name="join", axis=1),
            ],
            TensorProto.UINT8,
            "read by GlobalAveragePool",
        ),
    ],
)
def test_another_form_is_left_alone_and_says_why(nodes, kind, said) -> None:
    model = single_view(nodes, {"weight": WEIGHT}, kind=kind)
    folding = fold_pixels(model)
    assert folding.model is model
    assert folding.folded == ()
    assert said in str(folding.reason)
