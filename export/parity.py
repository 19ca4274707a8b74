"""Proof that the exported graph computes what torch does, with and without the native library."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from export.errors import ExportError
from export.mode import eval_mode
from runtime.session import Session, open_session

GOAL = 1e-4
"""Largest max|a - b| / max|a| of an output: float32 sums in another order stay two decades below."""


@dataclass(frozen=True, slots=True)
class OutputParity:
    """One output's worst frame.

    Attributes:
        name: of the output.
        function_body: max|torch - onnxruntime| / max|torch| where the function body computes the
            correlations.
        native: the same where the native library does; None where it is not built.
    """

    name: str
    function_body: float
    native: float | None

    @property
    def worst(self) -> float:
        """The larger of the two; infinite where a value is not finite."""
        return max(self.function_body, self.native or 0.0)


@dataclass(frozen=True, slots=True)
class ParityReport:
    """What ``measure_parity`` found.

    Attributes:
        outputs: one entry an output of the graph.
        frames: how many frames were compared.
        goal: what each ``worst`` must not exceed.
    """

    outputs: tuple[OutputParity, ...]
    frames: int
    goal: float

    @property
    def passed(self) -> bool:
        """Whether every output reached the goal."""
        return all(output.worst <= self.goal for output in self.outputs)

    def lines(self) -> list[str]:
        """One line an output, for people."""
        return [
            f"{output.name}: max|a-b|/max|a| {output.function_body:.1e} by the function body, "
            + (f"{output.native:.1e} by the native library" if output.native is not None else "native not built")
            + f", on {self.frames} frames"
            for output in self.outputs
        ]


def measure_parity(
    module: nn.Module,
    model: bytes | Path,
    frames: Iterable[Mapping[str, NDArray[Any]]],
    *,
    goal: float = GOAL,
) -> ParityReport:
    """Runs the same frames through torch and ONNX Runtime.

    Args:
        module: What was exported (with its wrapper, if it had one); run in eval mode, its mode put back.
        model: The exported file or its bytes.
        frames: Inputs by name, in the order of ``forward``; at least one frame.
        goal: Bound of the report.

    Returns:
        The report; it does not judge, the caller does.

    Raises:
        ExportError: No frame was given, or torch gave other shapes than the graph.
        SessionError: The graph cannot be loaded or run.
    """
    count = 0
    with (
        eval_mode(module),
        open_session(model, use_native=False, name="exported model") as plain,
        open_session(model, use_native=True, name="exported model") as native,
    ):
        names = [item.name for item in plain.outputs]
        loaded = native.native_loaded
        worst = np.zeros((2, len(names)))
        for frame in frames:
            expected = _run_torch(module, frame)
            worst[0] = np.maximum(worst[0], _differences(expected, plain, frame))
            if loaded:
                worst[1] = np.maximum(worst[1], _differences(expected, native, frame))
            count += 1
    if count == 0:
        raise ExportError("parity: found no frame; expected at least one; name a --source with frames")
    outputs = tuple(
        OutputParity(name, float(worst[0, index]), float(worst[1, index]) if loaded else None)
        for index, name in enumerate(names)
    )
    return ParityReport(outputs=outputs, frames=count, goal=goal)


def _run_torch(module: nn.Module, frame: Mapping[str, NDArray[Any]]) -> list[NDArray[Any]]:
    with torch.no_grad():
        outputs: Tensor | Sequence[Tensor] = module(*(torch.from_numpy(array) for array in frame.values()))
    return [item.numpy() for item in ([outputs] if isinstance(outputs, Tensor) else outputs)]


def _differences(
    expected: list[NDArray[Any]], session: Session, frame: Mapping[str, NDArray[Any]]
) -> NDArray[np.float64]:
    found = session.run(frame)
    shapes, wanted = [item.shape for item in found], [item.shape for item in expected]
    if shapes != wanted:
        raise ExportError(f"parity: found outputs of shapes {shapes}; expected torch's {wanted}; export again")
    return np.array([_relative(a, b) for a, b in zip(expected, found, strict=True)])


def _relative(expected: NDArray[Any], found: NDArray[Any]) -> float:
    """max|a - b| / max|a|; a pair that is not finite is infinitely far apart."""
    difference = np.abs(expected.astype(np.float64) - found)
    largest = float(np.abs(expected).max(initial=0.0))
    if not np.isfinite(difference).all() or not np.isfinite(largest):
        return float("inf")
    if largest == 0.0:
        return 0.0 if not difference.any() else float("inf")
    return float(difference.max() / largest)
