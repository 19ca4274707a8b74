"""The function body alone, without the native library: any D, any size, one body for all nodes."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.contracts.correlation import stereo_correlation
from runtime.session import open_session

onnx = pytest.importorskip("onnx")
from export.function_body import stereo_correlation_function  # noqa: E402

FLOAT32_SUM = 2e-6
"""Means of up to 64 products of order 1 in float32, against float64."""

TWO_DISPARITIES = (24, 5)


@pytest.fixture(scope="module", params=[18, 21])
def two_node_model(request: pytest.FixtureRequest) -> bytes:
    """Two nodes of different D, one function, no extent fixed."""
    shape = ("B", "C", "H", "W")
    inputs = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape) for name in ("left", "right")]
    outputs = [
        onnx.helper.make_tensor_value_info(f"volume{count}", onnx.TensorProto.FLOAT, ("B", count, "H", "W"))
        for count in TWO_DISPARITIES
    ]
    nodes = [
        onnx.helper.make_node(
            "StereoCorrelation", ["left", "right"], [f"volume{count}"], domain="edge.stereo", max_disparity=count
        )
        for count in TWO_DISPARITIES
    ]
    model = onnx.helper.make_model(
        onnx.helper.make_graph(nodes, "two_nodes", inputs, outputs),
        opset_imports=[onnx.helper.make_opsetid("", request.param), onnx.helper.make_opsetid("edge.stereo", 1)],
        ir_version=10,
        functions=[stereo_correlation_function(request.param)],
    )
    onnx.checker.check_model(model, full_check=True)
    return bytes(model.SerializeToString())


@pytest.mark.parametrize(
    "shape",
    [(1, 1, 1, 1), (1, 13, 2, 4), (2, 3, 4, 5), (1, 7, 3, 24), (3, 13, 5, 37), (1, 64, 6, 80)],
)
def test_one_body_serves_both_nodes_at_any_size(two_node_model: bytes, shape: tuple[int, ...]) -> None:
    left, right = np.random.default_rng(1).standard_normal((2, *shape)).astype(np.float32)
    with open_session(two_node_model, use_native=False) as session:
        volumes = session.run({"left": left, "right": right})
    for volume, count in zip(volumes, TWO_DISPARITIES, strict=True):
        expected = stereo_correlation(left, right, count)
        np.testing.assert_allclose(volume, expected, rtol=0, atol=FLOAT32_SUM, strict=True)


def test_reference_evaluator_agrees(two_node_model: bytes) -> None:
    """onnx's own interpreter, which shares no code with onnxruntime."""
    from onnx.reference import ReferenceEvaluator

    left, right = np.random.default_rng(2).standard_normal((2, 2, 3, 4, 9)).astype(np.float32)
    volumes = ReferenceEvaluator(onnx.load_from_string(two_node_model)).run(None, {"left": left, "right": right})
    for volume, count in zip(volumes, TWO_DISPARITIES, strict=True):
        np.testing.assert_allclose(volume, stereo_correlation(left, right, count), rtol=0, atol=FLOAT32_SUM)
