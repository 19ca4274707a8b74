"""Every instruction set against the NumPy oracle, through ONNX Runtime as users run it."""

from __future__ import annotations

import ctypes
import itertools
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.correlation import qlinear_stereo_correlation, stereo_correlation
from runtime.contracts.errors import SessionError
from runtime.session import open_session

FLOAT32_SUM = 2e-6
"""Sums of up to 128 products of order 1 in float32, against float64; seen: 3e-7."""

SHAPES = [
    # batch, channels, height, width, disparities
    (0, 3, 2, 5, 2),
    (1, 1, 1, 1, 1),
    (2, 1, 3, 5, 7),  # W < D
    (1, 13, 2, 7, 7),  # W = D
    (1, 13, 3, 16, 24),
    (3, 13, 5, 37, 24),  # W no multiple of any vector
    (2, 13, 9, 127, 13),
    (1, 64, 7, 64, 47),  # disparities no multiple of any tile
    (1, 128, 4, 33, 2),
]


@pytest.mark.parametrize(("batch", "channels", "height", "width", "disparities"), SHAPES)
def test_float_kernel_equals_the_oracle(
    instruction_set: str,
    float_model: Callable[..., bytes],
    batch: int,
    channels: int,
    height: int,
    width: int,
    disparities: int,
) -> None:
    rng = np.random.default_rng(3)
    left, right = rng.standard_normal((2, batch, channels, height, width)).astype(np.float32)
    with open_session(float_model(disparities), threads=2) as session:
        (volume,) = session.run({"left": left, "right": right})
    assert volume.shape == (batch, disparities, height, width)
    np.testing.assert_allclose(
        volume, stereo_correlation(left, right, disparities), rtol=0, atol=FLOAT32_SUM, strict=True
    )


@pytest.mark.parametrize(("batch", "channels", "height", "width", "disparities"), SHAPES)
def test_quantized_kernel_equals_the_oracle_to_the_bit(
    instruction_set: str,
    quantized_model: Callable[..., bytes],
    batch: int,
    channels: int,
    height: int,
    width: int,
    disparities: int,
) -> None:
    rng = np.random.default_rng(4)
    for types in itertools.product((np.uint8, np.int8), repeat=3):
        limits = [(np.iinfo(kind).min, np.iinfo(kind).max + 1) for kind in types]
        left, right = (
            rng.integers(*limits[side], (batch, channels, height, width)).astype(types[side]) for side in (0, 1)
        )
        zeros = [kind(rng.integers(*limit)) for kind, limit in zip(types, limits, strict=True)]
        scales = rng.uniform(0.001, 0.1, 3).astype(np.float32)
        scales[2] = scales[0] * scales[1] * rng.uniform(20, 4000)  # some volumes saturate, some hardly vary
        expected = qlinear_stereo_correlation(
            left, scales[0], zeros[0], right, scales[1], zeros[1], scales[2], zeros[2], disparities
        )
        model = quantized_model(disparities, types=types, scales=scales, zeros=zeros)
        with open_session(model, threads=2) as session:
            (volume,) = session.run({"left": left, "right": right})
        np.testing.assert_array_equal(volume, expected, strict=True)


def test_quantized_halves_round_to_even(instruction_set: str, quantized_model: Callable[..., bytes]) -> None:
    values = np.arange(-128, 128, dtype=np.int8).reshape(1, 1, 1, 256)
    zeros, scales = [np.int8(0)] * 3, np.array([0.5, 1.0, 1.0], np.float32)
    model = quantized_model(1, types=(np.int8,) * 3, scales=scales, zeros=zeros)
    with open_session(model) as session:
        (volume,) = session.run({"left": values, "right": np.ones_like(values)})
    assert volume.ravel().tolist() == [round(value / 2) for value in range(-128, 128)]


def test_shape_is_inferred(native_library: ctypes.CDLL, float_model: Callable[..., bytes]) -> None:
    """ONNX Runtime refuses a graph whose declared output contradicts the inferred shape."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load_from_string(float_model(4, shape=(1, 2, 3, 5)))
    with open_session(model.SerializeToString()) as session:
        assert session.outputs[0].shape == (1, 4, 3, 5)


@pytest.mark.parametrize(
    ("left", "right"), [((1, 2, 3, 4), (1, 2, 3, 5)), ((1, 2, 3, 4), (1, 1, 3, 4)), ((1, 0, 3, 4), (1, 0, 3, 4))]
)
def test_unequal_views_are_an_error(
    native_library: ctypes.CDLL,
    float_model: Callable[..., bytes],
    left: tuple[int, ...],
    right: tuple[int, ...],
) -> None:
    with (
        open_session(float_model(3)) as session,
        pytest.raises(SessionError, match="left and right must both be"),
    ):
        session.run({"left": np.zeros(left, np.float32), "right": np.zeros(right, np.float32)})


def test_zero_scale_is_an_error(native_library: ctypes.CDLL, quantized_model: Callable[..., bytes]) -> None:
    zeros, scales = [np.uint8(0)] * 3, np.array([1.0, 1.0, 0.0], np.float32)
    view = np.zeros((1, 1, 1, 4), np.uint8)
    model = quantized_model(2, types=(np.uint8,) * 3, scales=scales, zeros=zeros)
    with open_session(model) as session, pytest.raises(SessionError, match="scales must be finite"):
        session.run({"left": view, "right": view})


def test_no_disparity_is_an_error(native_library: ctypes.CDLL, float_model: Callable[..., bytes]) -> None:
    with pytest.raises(SessionError, match="max_disparity must be at least 1"):
        open_session(float_model(0))


def test_unknown_instruction_set_is_an_error(
    native_library: ctypes.CDLL, float_model: Callable[..., bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("EDGE_NATIVE_ISA", "mmx")
    with pytest.raises(SessionError, match="EDGE_NATIVE_ISA must be one of"):
        open_session(float_model(2))


def test_old_api_is_an_error_and_not_silence(native_library: ctypes.CDLL) -> None:
    """Registration against an API table that has no version 18, as an older onnxruntime would offer."""
    messages: list[str] = []
    create = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p)
    get_api = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_uint32)

    def create_status(code: int, message: bytes) -> int:
        messages.append(message.decode())
        return 0xBAD

    keep = create(create_status)
    table = (ctypes.c_void_p * 1)(ctypes.cast(keep, ctypes.c_void_p))
    offer = get_api(lambda version: ctypes.addressof(table) if version == 1 else None)

    class ApiBase(ctypes.Structure):
        _fields_ = (("get_api", get_api), ("get_version", ctypes.c_void_p))

    native_library.RegisterCustomOps.restype = ctypes.c_void_p
    base = ApiBase(offer, None)
    assert native_library.RegisterCustomOps(None, ctypes.byref(base)) == 0xBAD
    assert messages == ["edge.stereo needs onnxruntime 1.18 or newer"]


@pytest.mark.slow
def test_builds_into_an_empty_folder(fresh_build: Path) -> None:
    assert ctypes.CDLL(str(fresh_build)).EdgeStereoInstructionSet is not None
    assert [path.name for path in fresh_build.parent.iterdir()] == [fresh_build.name]
