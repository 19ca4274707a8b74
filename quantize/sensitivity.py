"""Which layers INT8 disturbs: signal-to-noise of every tensor, and of the outputs when one layer alone is
INT8.

The first is a picture of the finished model: how far each tensor has drifted from its float twin, all noise
from before included. The second tells which layer causes what: with one layer alone in INT8, the noise at
the network's outputs is its own; the layers in order of that noise are what an accuracy budget gives back
first.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from calib.methods import Range
from calib.ranges import Feeds, Observation, Progress, no_progress, split_groups, with_outputs
from quantize.placement import PRODUCTS
from quantize.prepare import Prepared
from quantize.qdq import QuantisedGraph
from quantize.static import build
from runtime.session import open_session

NO_NOISE_DB = 200.0
"""What is reported where the two agree to the bit."""

_TYPES = {"uint8": onnx.TensorProto.UINT8, "int8": onnx.TensorProto.INT8}
_FLOAT_BYTES = 4


@dataclass(frozen=True, slots=True)
class LayerNoise:
    """One layer of the INT8 model against its float twin.

    Attributes:
        node: name.
        operator: its type.
        snr_db: 10 log10 of signal energy over noise energy at its output, all noise from before included.
        multiply_adds: its cost.
    """

    node: str
    operator: str
    snr_db: float
    multiply_adds: int


@dataclass(frozen=True, slots=True)
class OwnNoise:
    """One layer alone in INT8.

    Attributes:
        node: name.
        snr_db: at the worst of the network's outputs.
        multiply_adds: its cost.
    """

    node: str
    snr_db: float
    multiply_adds: int


class _Energy:
    """Sums signal and noise over frames."""

    def __init__(self) -> None:
        self.signal = self.noise = 0.0

    def add(self, signal: NDArray[Any], other: NDArray[Any]) -> None:
        wide = signal.astype(np.float64)
        self.signal += float((wide**2).sum())
        self.noise += float(((wide - other) ** 2).sum())

    @property
    def snr_db(self) -> float:
        if self.noise == 0.0:
            return NO_NOISE_DB
        if self.signal == 0.0:
            return -NO_NOISE_DB
        return float(np.clip(10 * np.log10(self.signal / self.noise), -NO_NOISE_DB, NO_NOISE_DB))


def layer_noise(prepared: Prepared, graph: QuantisedGraph, feeds: Callable[[], Iterable[Feeds]]) -> list[LayerNoise]:
    """Signal-to-noise at the output of every layer that multiplies, in the order of the graph.

    A layer that ends the network is compared at the output of the network.

    Args:
        prepared: The float model.
        graph: The INT8 one.
        feeds: Starts an iteration over a few frames; called once a group of tensors.
    """
    outputs = prepared.placement.outputs
    layers = [node for node in prepared.model.graph.node if node.name in outputs and node.op_type in PRODUCTS]
    tensor_of = {node.name: outputs[node.name][0] for node in layers}
    compared = [name for name in dict.fromkeys(tensor_of.values()) if name in graph.tensors]
    energies = _compare(prepared, graph, compared, feeds)
    ends = _network_output_of(prepared, [tensor_of[node.name] for node in layers])
    costs = prepared.products
    found = []
    for node in layers:
        tensor = tensor_of[node.name]
        energy = energies.get(tensor) or energies.get(ends.get(tensor, ""))
        if energy is not None:
            found.append(LayerNoise(node.name, node.op_type, energy.snr_db, costs.get(node.name, 0)))
    return found


def own_noise(
    prepared: Prepared,
    observation: Observation,
    ranges: Mapping[str, Range],
    feeds: Sequence[Feeds],
    *,
    progress: Progress = no_progress,
) -> list[OwnNoise]:
    """Layers in order of the noise that each alone puts on the outputs, worst first.

    Args:
        prepared: The float model.
        observation: Its calibration.
        ranges: Of its tensors.
        feeds: A few frames.
        progress: Told after every layer.
    """
    layers = [name for name in prepared.products if name in prepared.placement.nodes]
    with open_session(prepared.model.SerializeToString(), name="float model") as session:
        wanted = [session.run(feed) for feed in feeds]
    found = []
    for number, layer in enumerate(layers):
        graph = build(prepared, observation, ranges, given_back=[name for name in layers if name != layer])
        with open_session(graph.model.SerializeToString(), name=f"model with {layer} in INT8") as session:
            energies = [_Energy() for _ in session.outputs]
            for feed, expected in zip(feeds, wanted, strict=True):
                for energy, signal, other in zip(energies, expected, session.run(feed), strict=True):
                    energy.add(signal, other)
        worst = min(energy.snr_db for energy in energies)
        found.append(OwnNoise(layer, worst, prepared.products[layer]))
        progress("ranking layers", number + 1, len(layers))
    return sorted(found, key=lambda item: item.snr_db)


def _compare(
    prepared: Prepared,
    graph: QuantisedGraph,
    tensors: Sequence[str],
    feeds: Callable[[], Iterable[Feeds]],
) -> dict[str, _Energy]:
    """Energies of 8-bit tensors and of the network's outputs, group by group in bounded memory."""
    network_outputs = [item.name for item in prepared.model.graph.output]
    sizes = {name: 2 * _FLOAT_BYTES * int(np.prod(shape)) for name, shape in prepared.shapes.items() if name in tensors}
    energies: dict[str, _Energy] = {}
    for group in split_groups(tensors, sizes) or [[]]:
        wanted = [*group, *network_outputs]
        levels = [graph.tensors[name][0] for name in group]
        types = {graph.tensors[name][0]: _TYPES[graph.tensors[name][1].dtype] for name in group}
        with (
            open_session(with_outputs(prepared.model, group), name="float model") as float_session,
            open_session(_with_levels(graph.model, types), name="INT8 model") as int8_session,
        ):
            group_energies = {name: _Energy() for name in wanted}
            for feed in feeds():
                signals = float_session.run(feed, outputs=wanted)
                others = int8_session.run(feed, outputs=[*levels, *network_outputs])
                for name, signal, other in zip(wanted, signals, others, strict=True):
                    if name in graph.tensors and name in group:
                        other = graph.tensors[name][1].dequantize(other)
                    group_energies[name].add(signal, other)
            energies.update(group_energies)
    return energies


def _with_levels(model: onnx.ModelProto, types: Mapping[str, int]) -> bytes:
    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    for name, kind in types.items():
        copy.graph.output.append(onnx.helper.make_tensor_value_info(name, kind, None))
    serialised: bytes = copy.SerializeToString()
    return serialised


def _network_output_of(prepared: Prepared, tensors: Sequence[str]) -> dict[str, str]:
    """Tensors that reach an output of the network through moves alone, with that output."""
    producer = {name: node for node in prepared.model.graph.node for name in node.output}
    wanted, found = set(tensors), {}
    for output in prepared.model.graph.output:
        name = output.name
        while name not in wanted and name in producer and producer[name].op_type in ("Reshape", "Transpose"):
            name = producer[name].input[0]
        if name in wanted:
            found[name] = output.name
    return found
