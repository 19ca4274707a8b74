"""The one place where ONNX Runtime sessions are made.

A model's correlation nodes run in our native library where that was built, and otherwise by the function
body that every exported file carries: the same numbers, more slowly. ``EDGE_NATIVE=0`` in the environment
turns the library off. The sums of an INT8 graph are exact on every processor. ONNX Runtime's log is silenced: what
matters reaches the caller as a ``SessionError``.
"""

from __future__ import annotations

import logging
import mmap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray
from onnxruntime.capi import onnxruntime_pybind11_state as ort_state

from runtime.contracts.correlation import DOMAIN
from runtime.contracts.errors import SessionError
from runtime.machine import processor
from runtime.native.library import is_wanted, library_path

NOT_BUILT = (
    "native correlation library: not built, so the model's own function body serves (same results, slower);"
    " install a C++17 compiler and run python -m runtime.native.build"
)

Array = NDArray[Any]

_log = logging.getLogger(__name__)
_said: set[str] = set()
_FATAL_ONLY = 4
_EXACT_PRODUCTS = ("session.x64quantprecision", "1")
"""Without 8-bit dot products a processor adds two u8 x s8 products in 16 bits, which saturate. With this ONNX Runtime
takes another kernel where weights exceed 7 bits; on some processors with such products, too, at twice the time, so that
it is asked for only where it is needed."""
_ORT_ERRORS: tuple[type[Exception], ...] = (
    *(kind for kind in vars(ort_state).values() if isinstance(kind, type) and issubclass(kind, Exception)),
    RuntimeError,
    ValueError,
)
_DTYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(double)": np.float64,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
    "tensor(int8)": np.int8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}


@dataclass(frozen=True, slots=True)
class TensorInfo:
    """One input or output of a graph.

    Attributes:
        name: as in the file.
        shape: one entry a dimension; None where the file leaves it open.
        dtype: numpy dtype of its elements.
    """

    name: str
    shape: tuple[int | None, ...]
    dtype: np.dtype[Any]


class Session:
    """A loaded model. A context manager: leaving it frees the model's memory.

    Attributes:
        inputs: what ``run`` wants, in the file's order.
        outputs: what ``run`` gives, in the file's order.
        native_loaded: whether the native library computes the model's correlations.
        notice: one line where the library was wanted and the function body serves instead, else None.
    """

    def __init__(self, session: ort.InferenceSession, *, name: str, native_loaded: bool, notice: str | None) -> None:
        """Wraps a session that ``open_session`` made."""
        self._session: ort.InferenceSession | None = session
        self._name = name
        self.inputs = tuple(_tensor_info(item) for item in session.get_inputs())
        self.outputs = tuple(_tensor_info(item) for item in session.get_outputs())
        self.native_loaded = native_loaded
        self.notice = notice

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Frees the model."""
        self.close()

    def close(self) -> None:
        """Frees the model's memory; a second call does nothing."""
        self._session = None

    def run(self, feeds: Mapping[str, Array], *, outputs: Sequence[str] | None = None) -> tuple[Array, ...]:
        """Computes the outputs of one set of inputs.

        Args:
            feeds: one array an input, of its name, shape and dtype.
            outputs: names of the outputs wanted; None is all, in the file's order.

        Returns:
            One array an output.

        Raises:
            SessionError: The feeds do not fit the inputs, an output is unknown, or ONNX Runtime failed.
        """
        session = self._open()
        _check_feeds(self._name, feeds, self.inputs)
        names = [item.name for item in self.outputs] if outputs is None else list(outputs)
        unknown = sorted(set(names) - {item.name for item in self.outputs})
        if unknown:
            raise SessionError(
                f"{self._name}: found no output {unknown[0]!r}; expected one of"
                f" {[item.name for item in self.outputs]}; ask for those"
            )
        try:
            return tuple(session.run(names, dict(feeds)))
        except _ORT_ERRORS as error:
            raise SessionError(
                f"{self._name}: found that ONNX Runtime cannot run it ({_first_line(error)});"
                " expected a model of this project; export or quantize it again"
            ) from error

    def end_profiling(self) -> Path:
        """Ends the profile that ``open_session(profile=...)`` began.

        Returns:
            The JSON file that ONNX Runtime wrote.
        """
        return Path(self._open().end_profiling())

    def _open(self) -> ort.InferenceSession:
        if self._session is None:
            raise SessionError(f"{self._name}: found a closed session; expected an open one; run inside its with block")
        return self._session


def open_session(
    model: str | Path | bytes,
    *,
    threads: int | None = None,
    use_native: bool = True,
    profile: Path | None = None,
    optimize: bool = True,
    prepack: bool = True,
    name: str | None = None,
) -> Session:
    """Loads a model on the CPU.

    Args:
        model: Path of an ONNX file, or its bytes.
        threads: Threads of one operator; None leaves it to ONNX Runtime (all cores).
        use_native: Whether to take the native correlation library where it was built; ``EDGE_NATIVE=0`` wins.
        profile: Prefix of a JSON file that tells the time of each operator; written by ``end_profiling``.
        optimize: Whether ONNX Runtime may fuse operators; False keeps each node as the file has it.
        prepack: Whether kernels may keep weights in a layout of their own; False is slower and leaves the weights'
            shapes in the profile.
        name: What error messages call the model; its path, or "model" for bytes, where not given.

    Returns:
        The session, to be used in a ``with`` block.

    Raises:
        SessionError: The file is missing, truncated, no ONNX model, or holds operators that nothing knows.
    """
    label = name or ("model" if isinstance(model, bytes) else str(model))
    source: str | bytes = model if isinstance(model, bytes) else str(model)
    if isinstance(source, str) and not Path(source).is_file():
        raise SessionError(f"{label}: found no such file; expected an ONNX model; check the path or export one")

    options = _options(threads=threads, profile=profile, optimize=optimize, prepack=prepack)
    native_loaded, notice = False, None
    if use_native and is_wanted():
        refusal = _register_native(options)
        native_loaded = refusal is None
        if refusal is not None:
            options = _options(threads=threads, profile=profile, optimize=optimize, prepack=prepack)
            notice = refusal if _has_custom_nodes(source) else None
    if notice is not None and notice not in _said:
        _said.add(notice)
        _log.warning(notice)
    try:
        session = ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    except _ORT_ERRORS as error:
        raise SessionError(_load_failure(label, error)) from error
    return Session(session, name=label, native_loaded=native_loaded, notice=notice)


def _options(*, threads: int | None, profile: Path | None, optimize: bool, prepack: bool) -> ort.SessionOptions:
    options = ort.SessionOptions()
    options.log_severity_level = _FATAL_ONLY
    options.inter_op_num_threads = 1
    if not _has_int8_dot_products():
        options.add_session_config_entry(*_EXACT_PRODUCTS)
    if not prepack:
        options.add_session_config_entry("session.disable_prepacking", "1")
    if threads is not None:
        if threads < 1:
            raise SessionError(f"threads: found {threads}; expected at least 1; leave it out for all cores")
        options.intra_op_num_threads = threads
    if profile is not None:
        options.enable_profiling = True
        options.profile_file_prefix = str(profile)
    if not optimize:
        options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    return options


@cache
def _has_int8_dot_products() -> bool:
    """Asked once: a search opens hundreds of sessions, and systems of many cores write long lists of them."""
    return processor().has_int8_dot_products


def _register_native(options: ort.SessionOptions) -> str | None:
    """Registers the library; returns None, or one line that says why the function body serves."""
    path = library_path()
    if path is None:
        return NOT_BUILT
    try:
        options.register_custom_ops_library(str(path))
    except _ORT_ERRORS as error:
        return (
            f"native correlation library: refused by ONNX Runtime ({_first_line(error)}), so the model's own"
            " function body serves (same results, slower); run python -m runtime.native.build"
        )
    return None


def _has_custom_nodes(source: str | bytes) -> bool:
    marker = DOMAIN.encode()
    if isinstance(source, bytes):
        return marker in source
    if Path(source).stat().st_size == 0:
        return False
    with Path(source).open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return content.find(marker) >= 0


def _check_feeds(name: str, feeds: Mapping[str, Array], inputs: tuple[TensorInfo, ...]) -> None:
    expected = {item.name: item for item in inputs}
    if feeds.keys() != expected.keys():
        raise SessionError(f"{name}: found inputs {sorted(feeds)}; expected {sorted(expected)}; feed exactly these")
    for key, item in expected.items():
        array = feeds[key]
        fits = len(array.shape) == len(item.shape) and all(
            want is None or have == want for have, want in zip(array.shape, item.shape, strict=True)
        )
        if not fits or array.dtype != item.dtype:
            shape = tuple("any" if size is None else size for size in item.shape)
            raise SessionError(
                f"{name}: input {key!r}: found {array.dtype} {array.shape}; expected {item.dtype}"
                f" {shape}; preprocess for this model's manifest"
            )


def _load_failure(label: str, error: Exception) -> str:
    reason = _first_line(error)
    if isinstance(error, ort_state.InvalidProtobuf) or "No graph was found" in reason:
        return (
            f"{label}: found a truncated file or no ONNX model at all ({reason}); expected a whole ONNX file;"
            " copy or export it again"
        )
    if "not a registered function/op" in reason:
        return (
            f"{label}: found an operator that nothing here knows ({reason}); expected standard operators and"
            f" those of {DOMAIN} with their function body; export it with this project's edge export"
        )
    return (
        f"{label}: found that ONNX Runtime {ort.__version__} cannot load it ({reason}); expected an ONNX"
        " model of an opset and IR version that it knows; export it again or update onnxruntime"
    )


def _first_line(error: Exception) -> str:
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else type(error).__name__
    return text.removeprefix("[ONNXRuntimeError] : ").strip()


def _tensor_info(item: Any) -> TensorInfo:
    shape = tuple(size if isinstance(size, int) else None for size in item.shape)
    if item.type not in _DTYPES:
        raise SessionError(
            f"{item.name}: found element type {item.type}; expected one of {sorted(_DTYPES)}; export it again"
        )
    return TensorInfo(name=item.name, shape=shape, dtype=np.dtype(_DTYPES[item.type]))
