"""One-node models of the two operators, and the instruction sets to run them on."""

from __future__ import annotations

import ctypes
import platform
from collections.abc import Callable

import numpy as np
import pytest

from runtime.native import library
from runtime.native.build import BuildError, build, find_compiler, kernel_flags
from runtime.native.library import library_path

INSTRUCTION_SETS = [
    name.removesuffix(".cc").split("_")[1]
    for name in kernel_flags(platform.machine())
    if name.startswith("correlation_")
]


@pytest.fixture(scope="session")
def native_library() -> ctypes.CDLL:
    """The built library; tests skip where it is not built and cannot be."""
    path = library_path()
    if path is None:
        try:
            find_compiler()
        except BuildError as error:
            pytest.skip(str(error))
        pytest.fail("the native library is not built; run python -m runtime.native.build")
    return ctypes.CDLL(str(path))


@pytest.fixture(params=INSTRUCTION_SETS)
def instruction_set(
    request: pytest.FixtureRequest, native_library: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch
) -> str:
    """Each instruction set in turn; those that this machine lacks are skipped."""
    monkeypatch.setenv("EDGE_NATIVE_ISA", request.param)
    if library.instruction_set() is None:
        pytest.skip(f"this machine does not run {request.param}")
    return str(request.param)


@pytest.fixture(scope="session")
def float_model() -> Callable[..., bytes]:
    """Makes a model of one StereoCorrelation node without a function body, so that only the kernel can run."""
    onnx = pytest.importorskip("onnx")

    def make(disparities: int, *, shape: tuple[int | None, ...] = (None, None, None, None)) -> bytes:
        return _model(
            onnx,
            node=("StereoCorrelation", ["left", "right"], disparities),
            inputs={"left": (np.float32, shape), "right": (np.float32, shape)},
            output=np.float32,
            constants={},
        )

    return make


@pytest.fixture(scope="session")
def quantized_model() -> Callable[..., bytes]:
    """Makes a model of one QLinearStereoCorrelation node; scales and zero points are constants in it."""
    onnx = pytest.importorskip("onnx")

    def make(disparities: int, *, types: tuple[type, type, type], scales: np.ndarray, zeros: list[np.generic]) -> bytes:
        names = ["left_scale", "left_zero", "right_scale", "right_zero", "out_scale", "out_zero"]
        values = [value for pair in zip(scales, zeros, strict=True) for value in pair]
        shape = (None, None, None, None)
        return _model(
            onnx,
            node=("QLinearStereoCorrelation", ["left", *names[:2], "right", *names[2:]], disparities),
            inputs={"left": (types[0], shape), "right": (types[1], shape)},
            output=types[2],
            constants=dict(zip(names, values, strict=True)),
        )

    return make


def _model(onnx, *, node, inputs, output, constants) -> bytes:  # type: ignore[no-untyped-def]
    def info(name: str, kind: type, shape: tuple[int | None, ...]):  # type: ignore[no-untyped-def]
        return onnx.helper.make_tensor_value_info(name, onnx.helper.np_dtype_to_tensor_dtype(np.dtype(kind)), shape)

    op_type, names, disparities = node
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node(op_type, names, ["volume"], domain="edge.stereo", max_disparity=disparities)],
        "one_node",
        [info(name, *item) for name, item in inputs.items()],
        [info("volume", output, (None, None, None, None))],
        [onnx.numpy_helper.from_array(np.asarray(value), name) for name, value in constants.items()],
    )
    opsets = [onnx.helper.make_opsetid("", 18), onnx.helper.make_opsetid("edge.stereo", 1)]
    return onnx.helper.make_model(graph, opset_imports=opsets, ir_version=10).SerializeToString()


@pytest.fixture(scope="session")
def fresh_build(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    """Builds the library anew into an empty folder."""
    try:
        find_compiler()
    except BuildError as error:
        pytest.skip(str(error))
    return build(tmp_path_factory.mktemp("native"))
