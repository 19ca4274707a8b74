"""What a session refuses, in one line each, and that the native library changes no result."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import runtime.session
from runtime.contracts.correlation import stereo_correlation
from runtime.contracts.errors import SessionError
from runtime.machine import Processor
from runtime.native.library import library_path
from runtime.session import open_session

onnx = pytest.importorskip("onnx")
function_body = pytest.importorskip("export.function_body")

SAME_RESULT = 2e-6
"""Native kernel and function body sum 16 float32 products of order 1 in another order."""

SHAPE, DISPARITIES = (1, 16, 6, 40), 9


def one_node_model(op_type: str, *, body: bool, opset: int = 18, ir_version: int = 10) -> bytes:
    views = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, SHAPE) for name in ("left", "right")]
    volume = onnx.helper.make_tensor_value_info("volume", onnx.TensorProto.FLOAT, (1, DISPARITIES, *SHAPE[2:]))
    node = onnx.helper.make_node(
        op_type, ["left", "right"], ["volume"], domain="edge.stereo", max_disparity=DISPARITIES
    )
    return onnx.helper.make_model(
        onnx.helper.make_graph([node], "one_node", views, [volume]),
        opset_imports=[onnx.helper.make_opsetid("", opset), onnx.helper.make_opsetid("edge.stereo", 1)],
        ir_version=ir_version,
        functions=[function_body.stereo_correlation_function(opset)] if body else [],
    ).SerializeToString()


@pytest.fixture(scope="module")
def model() -> bytes:
    return one_node_model("StereoCorrelation", body=True)


@pytest.fixture
def feeds() -> dict[str, np.ndarray]:
    left, right = np.random.default_rng(0).standard_normal((2, *SHAPE)).astype(np.float32)
    return {"left": left, "right": right}


@pytest.fixture
def without_library(monkeypatch: pytest.MonkeyPatch) -> None:
    """As if the library had not been built, and nothing had been said about it yet."""
    monkeypatch.setattr(runtime.session, "library_path", lambda: None)
    monkeypatch.setattr(runtime.session, "_said", set())


def one_line(error: pytest.ExceptionInfo[SessionError]) -> str:
    text = str(error.value)
    assert "\n" not in text and "found" in text and "expected" in text
    return text


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(SessionError, match="found no such file") as error:
        open_session(tmp_path / "none.onnx")
    one_line(error)


@pytest.mark.parametrize("kept", [0, 1, 40, 0.5, 0.99])
def test_truncated_file(model: bytes, tmp_path: Path, kept: float) -> None:
    path = tmp_path / "cut.onnx"
    path.write_bytes(model[: int(kept * len(model)) if kept < 1 else int(kept)])
    with pytest.raises(SessionError) as error:
        open_session(path)
    assert str(path) in one_line(error)


def test_not_a_model(tmp_path: Path) -> None:
    path = tmp_path / "text.onnx"
    path.write_text("this is no model\n" * 50)
    with pytest.raises(SessionError, match="truncated file or no ONNX model") as error:
        open_session(path)
    one_line(error)


@pytest.mark.parametrize(("op_type", "body", "native"), [("Unheard", True, True), ("StereoCorrelation", False, False)])
def test_unknown_operator(op_type: str, body: bool, native: bool) -> None:
    with pytest.raises(SessionError, match="an operator that nothing here knows") as error:
        open_session(one_node_model(op_type, body=body), use_native=native)
    one_line(error)


def test_opset_and_ir_of_the_future() -> None:
    with pytest.raises(SessionError, match="cannot load it") as error:
        open_session(one_node_model("StereoCorrelation", body=False, ir_version=99))
    one_line(error)


def test_says_what_it_takes_and_gives(model: bytes) -> None:
    with open_session(model) as session:
        assert [(item.name, item.shape, item.dtype) for item in session.inputs] == [
            ("left", SHAPE, np.float32),
            ("right", SHAPE, np.float32),
        ]
        assert [item.name for item in session.outputs] == ["volume"]


def test_feeds_must_fit(model: bytes, feeds: dict[str, np.ndarray]) -> None:
    with open_session(model) as session:
        for wrong, said in (
            ({"left": feeds["left"]}, "found inputs \\['left'\\]"),
            (feeds | {"right": feeds["right"].astype(np.float64)}, "found float64"),
            (feeds | {"right": feeds["right"][..., :-1]}, r"found float32 \(1, 16, 6, 39\)"),
        ):
            with pytest.raises(SessionError, match=said) as error:
                session.run(wrong)
            one_line(error)
        with pytest.raises(SessionError, match="found no output 'depth'"):
            session.run(feeds, outputs=["depth"])


def test_closed_session(model: bytes, feeds: dict[str, np.ndarray]) -> None:
    with open_session(model) as session:
        pass
    with pytest.raises(SessionError, match="closed session"):
        session.run(feeds)


def test_threads_must_be_positive(model: bytes) -> None:
    with pytest.raises(SessionError, match="threads: found 0"):
        open_session(model, threads=0)


def test_native_and_body_agree(model: bytes, feeds: dict[str, np.ndarray]) -> None:
    if library_path() is None:
        pytest.skip("the native library is not built")
    expected = stereo_correlation(feeds["left"], feeds["right"], DISPARITIES)
    for use_native in (True, False):
        with open_session(model, use_native=use_native) as session:
            assert session.native_loaded is use_native and session.notice is None
            (volume,) = session.run(feeds)
        np.testing.assert_allclose(volume, expected, rtol=0, atol=SAME_RESULT)


def test_profile_shows_who_computed_it(model: bytes, feeds: dict[str, np.ndarray], tmp_path: Path) -> None:
    if library_path() is None:
        pytest.skip("the native library is not built")
    for use_native in (True, False):
        with open_session(model, use_native=use_native, profile=tmp_path / str(use_native)) as session:
            session.run(feeds)
            events = json.loads(session.end_profiling().read_text())
        ran = {event["args"]["op_name"] for event in events if event["cat"] == "Node" and "op_name" in event["args"]}
        assert ("StereoCorrelation" in ran, "MatMul" in ran) == (use_native, not use_native)


def test_environment_turns_the_library_off(
    model: bytes, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("EDGE_NATIVE", "0")
    with open_session(model) as session:
        assert not session.native_loaded and session.notice is None
    assert not caplog.records


@pytest.mark.usefixtures("without_library")
def test_missing_library_is_said_once(
    model: bytes, feeds: dict[str, np.ndarray], caplog: pytest.LogCaptureFixture
) -> None:
    for _ in range(2):
        with open_session(model) as session:
            assert not session.native_loaded
            assert session.notice is not None and "function body serves" in session.notice
            (volume,) = session.run(feeds)
    expected = stereo_correlation(feeds["left"], feeds["right"], DISPARITIES)
    np.testing.assert_allclose(volume, expected, rtol=0, atol=SAME_RESULT)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


@pytest.mark.usefixtures("without_library")
def test_missing_library_is_not_mentioned_for_a_model_without_correlation(
    caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    info = onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, (1,))
    out = onnx.helper.make_tensor_value_info("y", onnx.TensorProto.FLOAT, (1,))
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "relu", [info], [out])
    plain = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    path = tmp_path / "plain.onnx"
    path.write_bytes(plain.SerializeToString())
    for model in (path, path.read_bytes()):
        with open_session(model) as session:
            assert session.notice is None
    assert not caplog.records


def test_refused_library_is_said_and_the_body_serves(
    model: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "libedge_stereo.so"
    broken.write_bytes(b"no library")
    monkeypatch.setattr(runtime.session, "library_path", lambda: broken)
    monkeypatch.setattr(runtime.session, "_said", set())
    with open_session(model) as session:
        assert not session.native_loaded
        assert session.notice is not None and "refused by ONNX Runtime" in session.notice


def test_needs_no_workbench_package() -> None:
    """In a fresh interpreter: what was imported here before must not hide an import."""
    code = "import sys, runtime.session; print({'torch', 'onnx', 'cv2'} & set(sys.modules))"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "set()"


@pytest.mark.parametrize(("flags", "exact"), [(("avx2",), True), (None, True), (("avx2", "avx512_vnni"), False)])
def test_the_exact_kernel_is_asked_for_where_products_would_saturate(
    monkeypatch: pytest.MonkeyPatch, flags: tuple[str, ...] | None, exact: bool
) -> None:
    monkeypatch.setattr(runtime.session, "processor", lambda: Processor("a CPU", "x86_64", 2, flags))
    monkeypatch.setattr(runtime.session, "_has_int8_dot_products", runtime.session._has_int8_dot_products.__wrapped__)
    options = runtime.session._options(threads=None, profile=None, optimize=True, prepack=True)
    key, value = runtime.session._EXACT_PRODUCTS
    if exact:
        assert options.get_session_config_entry(key) == value
    else:
        with pytest.raises(RuntimeError, match=key):
            options.get_session_config_entry(key)


def test_products_of_bytes_do_not_saturate() -> None:
    """Two products of 255 and 127 exceed 16 bits: processors without 8-bit dot products would cut them off."""
    pixels, weights = np.full((64, 128), 255, np.uint8), np.full((128, 64), 127, np.int8)
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("MatMulInteger", ["pixels", "weights"], ["sums"])],
        "sums",
        [onnx.helper.make_tensor_value_info("pixels", onnx.TensorProto.UINT8, pixels.shape)],
        [onnx.helper.make_tensor_value_info("sums", onnx.TensorProto.INT32, (64, 64))],
        [onnx.numpy_helper.from_array(weights, "weights")],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)
    with open_session(model.SerializeToString()) as session:
        (sums,) = session.run({"pixels": pixels})
    np.testing.assert_array_equal(sums, pixels.astype(np.int32) @ weights.astype(np.int32))
