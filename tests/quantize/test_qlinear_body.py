"""The body of QLinearStereoCorrelation gives the oracle's bits in plain ONNX Runtime, and the kernel's."""

from __future__ import annotations

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

from quantize.correlation import qlinear_stereo_correlation_function  # noqa: E402
from runtime.contracts.correlation import (  # noqa: E402
    DOMAIN,
    MAX_DISPARITY,
    QLINEAR_STEREO_CORRELATION,
    VERSION,
    qlinear_stereo_correlation,
)
from runtime.native.library import library_path  # noqa: E402
from runtime.session import open_session  # noqa: E402

TYPES = {"uint8": TensorProto.UINT8, "int8": TensorProto.INT8}
ZERO_POINTS = {"uint8": 131, "int8": -7}
SCALES = (0.0131, 0.0217)


def model_of(nodes: list[tuple[str, int, str]], kinds: tuple[str, str], output_scale: float) -> bytes:
    """One QLinearStereoCorrelation for each (output, D, output type), all on the same inputs of open size."""
    constants = {"sl": np.float32(SCALES[0]), "sr": np.float32(SCALES[1]), "so": np.float32(output_scale)}
    constants["zl"], constants["zr"] = (np.array(ZERO_POINTS[kind], kind) for kind in kinds)
    made = []
    for output, disparities, kind in nodes:
        constants[f"{output}.zo"] = np.array(ZERO_POINTS[kind], kind)
        made.append(
            helper.make_node(
                QLINEAR_STEREO_CORRELATION,
                ["left", "sl", "zl", "right", "sr", "zr", "so", f"{output}.zo"],
                [output],
                domain=DOMAIN,
                **{MAX_DISPARITY: disparities},
            )
        )
    graph = helper.make_graph(
        made,
        "correlations",
        [
            helper.make_tensor_value_info(name, TYPES[kind], ["b", "c", "h", "w"])
            for name, kind in zip(("left", "right"), kinds, strict=True)
        ],
        [helper.make_tensor_value_info(output, TYPES[kind], None) for output, _, kind in nodes],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid(DOMAIN, VERSION)]
    functions = [qlinear_stereo_correlation_function(18)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=10, functions=functions)
    return bytes(model.SerializeToString())


def random_pair(shape: tuple[int, ...], kinds: tuple[str, str]) -> list[np.ndarray]:
    random = np.random.default_rng(sum(shape))
    return [random.integers(np.iinfo(k).min, np.iinfo(k).max, shape, k, endpoint=True) for k in kinds]


def expected(pair: list[np.ndarray], disparities: int, kind: str, output_scale: float) -> np.ndarray:
    left, right = pair
    zeros = [np.array(ZERO_POINTS[str(item.dtype)], item.dtype)[()] for item in pair]
    zero = np.array(ZERO_POINTS[kind], kind)[()]
    return qlinear_stereo_correlation(
        left, SCALES[0], zeros[0], right, SCALES[1], zeros[1], output_scale, zero, disparities
    )


@pytest.mark.parametrize("kinds", [("uint8", "uint8"), ("int8", "int8"), ("uint8", "int8"), ("int8", "uint8")])
@pytest.mark.parametrize(
    ("shape", "disparities"),
    [
        ((1, 1, 1, 1), 1),
        ((1, 3, 2, 5), 7),  # W < D
        ((2, 5, 3, 8), 8),  # W = D, a batch
        ((1, 17, 5, 33), 6),
        ((1, 64, 2, 127), 24),
    ],
)
def test_bits_of_the_oracle_without_the_library(shape, disparities, kinds) -> None:
    pair = random_pair(shape, kinds)
    output_scale = 0.02  # saturates now and then
    with open_session(model_of([("y", disparities, kinds[0])], kinds, output_scale), use_native=False) as session:
        (found,) = session.run({"left": pair[0], "right": pair[1]})
    assert found.dtype == np.dtype(kinds[0])
    np.testing.assert_array_equal(found, expected(pair, disparities, kinds[0], output_scale))


def test_one_body_serves_nodes_of_different_disparities_and_types() -> None:
    kinds = ("uint8", "uint8")
    model = model_of([("near", 3, "uint8"), ("far", 11, "int8")], kinds, 0.05)
    for shape in ((1, 4, 3, 9), (1, 4, 2, 20)):  # another image size in the same session's file
        pair = random_pair(shape, kinds)
        with open_session(model, use_native=False) as session:
            near, far = session.run({"left": pair[0], "right": pair[1]})
        np.testing.assert_array_equal(near, expected(pair, 3, "uint8", 0.05))
        np.testing.assert_array_equal(far, expected(pair, 11, "int8", 0.05))


@pytest.mark.skipif(library_path() is None, reason="the native library is not built")
def test_the_kernel_gives_the_same_bits() -> None:
    kinds, shape = ("uint8", "uint8"), (2, 19, 4, 45)
    pair = random_pair(shape, kinds)
    model = model_of([("y", 12, "uint8")], kinds, 0.03)
    with open_session(model) as native, open_session(model, use_native=False) as plain:
        assert native.native_loaded
        feed = {"left": pair[0], "right": pair[1]}
        np.testing.assert_array_equal(native.run(feed)[0], plain.run(feed)[0])
