"""What ONNX Runtime really ran: its own profile, node by node, with times, shapes and multiply-adds.

The profile is of the optimised graph, so it shows what was fused and what was not, whatever the file says.
"""

from __future__ import annotations

import json
import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from runtime.contracts.correlation import QLINEAR_STEREO_CORRELATION, STEREO_CORRELATION
from runtime.contracts.errors import SessionError
from runtime.session import open_session

INT8_PRODUCTS = frozenset(
    {"QLinearConv", "ConvInteger", "QLinearMatMul", "MatMulInteger", "QGemm", QLINEAR_STEREO_CORRELATION}
)
FLOAT_PRODUCTS = frozenset({"Conv", "FusedConv", "MatMul", "FusedMatMul", "Gemm", "FusedGemm", STEREO_CORRELATION})
_WEIGHT_INPUT = {"Conv": 1, "FusedConv": 1, "ConvInteger": 1, "QLinearConv": 3}
_MATRIX_PRODUCTS = frozenset({"MatMul", "FusedMatMul", "MatMulInteger", "Gemm", "FusedGemm", "QLinearMatMul", "QGemm"})
_OUTPUT_CHANNELS_ONLY = 1  # a vector in the weight's place: the weight itself was packed away
_KERNEL = "_kernel_time"
_WARM_UP_RUNS = 1

Shape = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class NodeTime:
    """One node of the optimised graph.

    Attributes:
        name: node name; operator: its type.
        ms: mean time a run in milliseconds.
        multiply_adds: a run; 0 for all but convolutions, matrix products and correlations, and where the profile
            does not tell.
    """

    name: str
    operator: str
    ms: float
    multiply_adds: int


@dataclass(frozen=True, slots=True)
class OperatorTime:
    """All nodes of one type.

    Attributes:
        operator: type; nodes: how many; ms: together, a run; multiply_adds: together, a run.
    """

    operator: str
    nodes: int
    ms: float
    multiply_adds: int


def profile_model(
    model: Path | str | bytes,
    feeds: Iterable[Mapping[str, NDArray[Any]]],
    *,
    threads: int | None = None,
    use_native: bool = True,
) -> list[NodeTime]:
    """Runs a model under ONNX Runtime's profiler.

    Args:
        model: ONNX file or its bytes.
        feeds: One or more sets of inputs; the first is run once more beforehand, uncounted.
        threads: Of one operator.
        use_native: Whether to take the native correlation library.

    Returns:
        Nodes in the order in which they ran, averaged over the feeds.

    Raises:
        SessionError: The model cannot be loaded or run, or there were no feeds.
    """
    sets = list(feeds)
    if not sets:
        raise SessionError("profile: found no inputs; expected one frame or more; give a source with frames")
    # Kernels that pack their weights drop the weights' shapes; a run without packing, untimed, still has them.
    unpacked = node_times(_events(model, sets[:1], threads=threads, use_native=use_native, prepack=False), runs=1)
    timed = node_times(
        _events(model, [*sets[:1] * _WARM_UP_RUNS, *sets], threads=threads, use_native=use_native, prepack=True),
        runs=len(sets),
        skipped_runs=_WARM_UP_RUNS,
    )
    costs = {(node.name, node.operator): node.multiply_adds for node in unpacked}
    return [
        replace(node, multiply_adds=max(node.multiply_adds, costs.get((node.name, node.operator), 0))) for node in timed
    ]


def _events(
    model: Path | str | bytes,
    sets: Sequence[Mapping[str, NDArray[Any]]],
    *,
    threads: int | None,
    use_native: bool,
    prepack: bool,
) -> list[dict[str, Any]]:
    """The profiler's events of one run a set."""
    with (
        tempfile.TemporaryDirectory(prefix="edge-profile-") as folder,
        open_session(
            model, threads=threads, use_native=use_native, profile=Path(folder) / "profile", prepack=prepack
        ) as session,
    ):
        for feed in sets:
            session.run(feed)
        events: list[dict[str, Any]] = json.loads(session.end_profiling().read_text(encoding="utf-8"))
    return events


def node_times(events: Iterable[Mapping[str, Any]], *, runs: int, skipped_runs: int = 0) -> list[NodeTime]:
    """Averages the profiler's events by node.

    Args:
        events: Of the profiler's JSON.
        runs: How many runs count.
        skipped_runs: How many runs before them do not.
    """
    groups: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for event in events:
        name = str(event.get("name", ""))
        if event.get("cat") == "Node" and name.endswith(_KERNEL):
            index = str(event.get("args", {}).get("node_index", ""))
            groups.setdefault((name.removesuffix(_KERNEL), index), []).append(event)
    found = []
    for (name, _), group in groups.items():
        repeats = max(len(group) // max(runs + skipped_runs, 1), 1)  # inside a loop a node runs more than once
        counted = group[skipped_runs * repeats :]
        arguments = group[0].get("args", {})
        operator = str(arguments.get("op_name", ""))
        cost = _multiply_adds(operator, _shapes(arguments, "input"), _shapes(arguments, "output"))
        ms = sum(float(event["dur"]) for event in counted) / max(runs, 1) / 1e3
        found.append(NodeTime(name, operator, ms, cost * repeats))
    return found


def by_operator(nodes: Iterable[NodeTime]) -> list[OperatorTime]:
    """Sums by type, the slowest first."""
    groups: dict[str, list[NodeTime]] = {}
    for node in nodes:
        groups.setdefault(node.operator, []).append(node)
    sums = [
        OperatorTime(operator, len(group), sum(node.ms for node in group), sum(node.multiply_adds for node in group))
        for operator, group in groups.items()
    ]
    return sorted(sums, key=lambda item: -item.ms)


def int8_share(nodes: Iterable[NodeTime]) -> float:
    """Share of the multiply-adds that ran in 8 bits, 0 to 1; correlations included.

    A correlation that ran by its function body shows up as the matrix product that it is made of, which computes
    more than the volume needs.
    """
    costs = {True: 0, False: 0}
    for node in nodes:
        if node.multiply_adds:
            costs[node.operator in INT8_PRODUCTS] += node.multiply_adds
    return costs[True] / max(sum(costs.values()), 1)


def _multiply_adds(operator: str, inputs: list[Shape], outputs: list[Shape]) -> int:
    if operator not in INT8_PRODUCTS | FLOAT_PRODUCTS or not outputs:
        return 0
    size = math.prod(outputs[0])
    if operator in _WEIGHT_INPUT:
        weight = inputs[_WEIGHT_INPUT[operator]] if len(inputs) > _WEIGHT_INPUT[operator] else ()
        return size * math.prod(weight[1:]) if len(weight) > _OUTPUT_CHANNELS_ONLY else 0
    if operator in _MATRIX_PRODUCTS and inputs and inputs[0]:
        return size * inputs[0][-1]
    if operator in (STEREO_CORRELATION, QLINEAR_STEREO_CORRELATION) and inputs:
        return size * inputs[0][1]
    return 0


def _shapes(arguments: Mapping[str, Any], side: str) -> list[Shape]:
    """Shapes as the profiler writes them: ``[{"uint8": [1, 64, 48, 224]}, ...]``."""
    return [
        tuple(int(extent) for extent in next(iter(item.values()), []))
        for item in arguments.get(f"{side}_type_shape", [])
    ]
