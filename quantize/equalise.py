"""Equalisation across layers: brings the channels of a tensor to like ranges before one scale serves them all.

An 8-bit tensor has one step for all its channels, so a channel that stays small keeps few levels. A
convolution may make channel c smaller by s_c and every convolution that reads it take s_c into its weights:
the network computes the same, as ReLU, pools, slices, concatenations and additions of equally scaled channels
commute with a positive factor (Nagel et al., Data-Free Quantization, 2019, section 4.1). The
weights that make the channel have a scale of their own an output channel, so nothing is lost there.

Channels that must share a factor (the two operands of an Add, a tensor and its slices) form one class. A
class that anything else reads, such as a correlation, a reshape or the caller, keeps the factor 1.
``s = max over tensors (peak of the channel / peak of the tensor) ** strength`` is at most 1: small channels
grow, none outgrows its tensor.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import numpy_helper

from quantize.graph import GraphIndex, attribute

Extremes = Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]]
STRENGTH = 0.5
"""1 would make all channels alike and leave the reading weights unlike; halfway each side bears the half."""

_SMALLEST = 2.0**-6
_STEPS_PER_OCTAVE = 4
"""Factors lie on a grid, so that a bit of difference in a peak does not make another model."""
_PASSING = frozenset({"Relu", "MaxPool", "AveragePool", "GlobalAveragePool", "Pad", "Slice", "Unsqueeze", "Squeeze"})


class ChannelClasses:
    """Which channels of which tensors share a factor.

    Attributes:
        of_tensor: tensor -> (C,) a member of each channel's class; `find` gives its representative.
    """

    def __init__(self, model: onnx.ModelProto, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Walks the graph once; convolutions make fresh classes."""
        self._index, self._shapes = GraphIndex(model), shapes
        self._parent: list[int] = [0]  # member 0: the class of factor 1
        self.of_tensor: dict[str, NDArray[np.int64]] = {}
        for name in self._index.inputs:
            self.of_tensor[name] = self._fixed(name)
        for node in model.graph.node:
            self._visit(node)
        for name in self._index.outputs:
            self._fix(name)

    def find(self, member: int) -> int:
        """The representative of a class; 0 where the factor is 1."""
        while self._parent[member] != member:
            member = self._parent[member]
        return member

    def classes(self, name: str) -> NDArray[np.int64]:
        """(C,) representatives of a tensor's channels."""
        return np.array([self.find(int(member)) for member in self.of_tensor[name]], np.int64)

    def _visit(self, node: onnx.NodeProto) -> None:
        kind = node.op_type
        data = [name for name in node.input if name in self.of_tensor]
        result = node.output[0]
        if kind == "Conv" and self._rescalable(node):
            self.of_tensor[result] = self._fresh(result)
        elif kind in _PASSING and self._keeps_channels(node):
            self.of_tensor[result] = self.of_tensor[node.input[0]]
        elif kind == "Add" and len(data) == 2 and len({self.of_tensor[name].size for name in data}) == 1:
            self._tie(data)
            self.of_tensor[result] = self.of_tensor[data[0]]
        elif kind == "Concat" and len(data) == len(node.input):
            if attribute(node, "axis") == 1:
                self.of_tensor[result] = np.concatenate([self.of_tensor[name] for name in data])
            elif len({self.of_tensor[name].size for name in data}) == 1:
                self._tie(data)
                self.of_tensor[result] = self.of_tensor[data[0]]
            else:
                self._end(node, data)
        else:
            self._end(node, data)

    def _end(self, node: onnx.NodeProto, data: Sequence[str]) -> None:
        """An operator that factors do not pass: what it reads keeps the factor 1."""
        for name in data:
            self._fix(name)
        for name in node.output:
            self.of_tensor[name] = self._fixed(name)

    def _rescalable(self, node: onnx.NodeProto) -> bool:
        constants = [name for name in node.input[1:] if name]
        return all(name in self._index.initializers and len(self._index.consumers[name]) == 1 for name in constants)

    def _keeps_channels(self, node: onnx.NodeProto) -> bool:
        if node.input[0] not in self.of_tensor or len(node.output) != 1:
            return False
        if node.op_type == "Slice":
            axes = self._index.constant(node.input[3]) if len(node.input) > 3 else None
            return axes is not None and 1 not in axes
        if node.op_type in ("Unsqueeze", "Squeeze"):
            axes = self._index.constant(node.input[1]) if len(node.input) > 1 else None
            return axes is not None and bool(np.all(np.asarray(axes) > 1))
        if node.op_type == "Pad":
            pads = self._index.constant(node.input[1])
            value = self._index.constant(node.input[2]) if len(node.input) > 2 and node.input[2] else np.zeros(())
            rank = None if pads is None else pads.size // 2
            return rank is not None and value is not None and not np.any(value) and not pads[[1, 1 + rank]].any()
        return True

    def _fixed(self, name: str) -> NDArray[np.int64]:
        return np.zeros(self._channels(name), np.int64)

    def _fresh(self, name: str) -> NDArray[np.int64]:
        first = len(self._parent)
        self._parent.extend(range(first, first + self._channels(name)))
        return np.arange(first, len(self._parent))

    def _channels(self, name: str) -> int:
        shape = self._shapes.get(name, ())
        return shape[1] if len(shape) > 1 else 1

    def _fix(self, name: str) -> None:
        for member in self.of_tensor.get(name, ()):
            self._parent[self.find(int(member))] = 0

    def _tie(self, names: Sequence[str]) -> None:
        for first, second in zip(
            self.of_tensor[names[0]], np.array([self.of_tensor[n] for n in names[1:]]).T, strict=True
        ):
            for other in second:
                low, high = sorted((self.find(int(first)), self.find(int(other))))
                self._parent[high] = low


def equalise(
    model: onnx.ModelProto,
    shapes: Mapping[str, tuple[int, ...]],
    extremes: Extremes,
    *,
    strength: float = STRENGTH,
) -> onnx.ModelProto:
    """A model that computes the same with more alike channels.

    Args:
        model: The float model; left as it is.
        shapes: Of its tensors.
        extremes: (C,) minima and maxima of the tensors that shall be alike within.
        strength: 0 changes nothing, 1 makes free channels as large as their tensor's largest.
    """
    classes = ChannelClasses(model, shapes)
    factor = _factors(classes, extremes, strength)
    result = onnx.ModelProto()
    result.CopyFrom(model)
    index = GraphIndex(result)
    for node in result.graph.node:
        if node.op_type != "Conv" or node.input[1] not in index.initializers:
            continue
        read = np.array([factor.get(int(item), 1.0) for item in classes.classes(node.input[0])])
        made = np.array([factor.get(int(item), 1.0) for item in classes.classes(node.output[0])])
        if np.all(read == 1.0) and np.all(made == 1.0):
            continue
        weight = numpy_helper.to_array(index.initializers[node.input[1]]).astype(np.float64)
        tail = [1] * (weight.ndim - 2)
        group = int(attribute(node, "group", 1))
        by_output = np.repeat(read.reshape(group, -1), weight.shape[0] // group, axis=0)  # (M, C / group)
        weight = weight * by_output.reshape(*by_output.shape, *tail) / made.reshape(-1, 1, *tail)
        _replace(index, node.input[1], weight)
        if len(node.input) > 2 and node.input[2]:
            _replace(index, node.input[2], numpy_helper.to_array(index.initializers[node.input[2]]) / made)
    return result


def equalisable(model: onnx.ModelProto, shapes: Mapping[str, tuple[int, ...]], tensors: Sequence[str]) -> list[str]:
    """Those of some tensors that have a channel whose factor is free: they need extremes."""
    classes = ChannelClasses(model, shapes)
    return [name for name in tensors if name in classes.of_tensor and np.any(classes.classes(name) != 0)]


def _factors(classes: ChannelClasses, extremes: Extremes, strength: float) -> dict[int, float]:
    """Factor by class; classes that were never seen, and that of factor 1, are left out."""
    largest: dict[int, float] = {}
    for name, (low, high) in extremes.items():
        peaks = np.maximum(np.abs(low), np.abs(high)).astype(np.float64)
        if name not in classes.of_tensor or peaks.max() == 0:
            continue
        for item, share in zip(classes.classes(name), peaks / peaks.max(), strict=True):
            if item != 0:
                largest[int(item)] = max(largest.get(int(item), 0.0), float(share))
    return {item: _on_grid(max(share, _SMALLEST) ** strength) for item, share in largest.items()}


def _on_grid(value: float) -> float:
    return float(2.0 ** (np.rint(np.log2(value) * _STEPS_PER_OCTAVE) / _STEPS_PER_OCTAVE))


def _replace(index: GraphIndex, name: str, value: NDArray[np.float64]) -> None:
    index.initializers[name].CopyFrom(numpy_helper.from_array(value.astype(np.float32), name))
