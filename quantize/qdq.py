"""Writes the INT8 graph: what `quantize.placement` decided, with scales from the ranges.

Convolutions, additions and pools stand between DequantizeLinear and QuantizeLinear, the form that ONNX
Runtime (and others) fuse into QLinearConv, QLinearAdd and so on, ReLU folded. Operators that only move
values, and the correlation, read 8-bit tensors directly, so that no fusion is needed for them. ONNX
Runtime's own quantiser does not know that a Slice or a padded Concat shares its input's scale, has no 8-bit
correlation, no range a column, and reads pixels as normalised floats: hence our own.

A convolution that ends the network becomes a product of integers whose 32-bit sums are scaled to the output, so that
the output is not rounded (`quantize.ends`). One that leaves pixels out gets one range a column of the network's output
(class logits, depth, size, ...), although its output tensor has a single scale: channel c is divided by its
column's step, which goes into the weight's scale and the bias and leaves the 8-bit weights as they are; the
DequantizeLinear behind it has the steps by channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from calib.methods import Range
from quantize.correlation import qlinear_stereo_correlation_function
from quantize.ends import window_nodes, window_of
from quantize.errors import QuantizeError
from quantize.graph import GraphIndex, attribute, prune
from quantize.placement import Placement, activations, moves
from quantize.qparams import (
    QuantParams,
    activation_params,
    quantize_bias,
    quantize_weight,
    scales_that_hold_bias,
    weight_scales,
)
from quantize.recipe import Recipe
from runtime.contracts.correlation import (
    DOMAIN,
    MAX_DISPARITY,
    QLINEAR_STEREO_CORRELATION,
    STEREO_CORRELATION,
)

Levels = Mapping[str, NDArray[np.int8]]
"""Convolution -> the levels of its weights, in their shape."""
ChannelExtremes = Mapping[str, tuple[NDArray[np.float32], NDArray[np.float32]]]
_PRODUCER = "edge quantize"
_MIDDLE = {"uint8": 128, "int8": 0}


@dataclass(frozen=True, slots=True)
class QuantisedGraph:
    """The result.

    Attributes:
        model: the INT8 model.
        tensors: float tensor of the old graph -> its 8-bit tensor in the new one, and what its levels mean.
    """

    model: onnx.ModelProto
    tensors: dict[str, tuple[str, QuantParams]]


def quantise_graph(
    model: onnx.ModelProto,
    placement: Placement,
    recipe: Recipe,
    *,
    ranges: Mapping[str, Range],
    channels: ChannelExtremes,
    shifts: Mapping[str, NDArray[np.float64]] | None = None,
    levels: Levels | None = None,
) -> QuantisedGraph:
    """Writes the INT8 graph.

    Args:
        model: The float model that was placed; left as it is.
        placement: Where 8 bits go.
        recipe: Types and bits.
        ranges: (low, high) by tensor, at least of ``placement.observed`` or their roots in a wider placement.
        channels: (C,) minima and maxima, at least of ``placement.observed_channels``.
        shifts: (M,) added to the bias of a convolution, by its name; those of float ones are not used.
        levels: Of a convolution's weights, by its name (`quantize.rounding`); the nearest ones where not given.

    Raises:
        QuantizeError: A range is missing or unusable.
    """
    return _Writer(model, placement, recipe, ranges, channels, shifts or {}, levels or {}).write()


def nearest_levels(model: onnx.ModelProto, placement: Placement, recipe: Recipe) -> dict[str, NDArray[np.int8]]:
    """Levels of all weights in 8 bits as `quantise_graph` works them out itself: for many graphs, once."""
    index = GraphIndex(model)
    found = {}
    for node in model.graph.node:
        if node.op_type == "Conv" and node.name in placement.nodes:
            weight = index.constant(node.input[1])
            assert weight is not None  # placement took only such
            scales = weight_scales(weight, bits=recipe.weight_bits, per_channel=recipe.weight_per_channel)
            found[node.name] = quantize_weight(weight, scales, bits=recipe.weight_bits)
    return found


class _Writer:
    """Holds the growing graph while the old one is walked once, in order."""

    def __init__(
        self,
        model: onnx.ModelProto,
        placement: Placement,
        recipe: Recipe,
        ranges: Mapping[str, Range],
        channels: ChannelExtremes,
        shifts: Mapping[str, NDArray[np.float64]],
        levels: Levels,
    ) -> None:
        self._model, self._placement, self._recipe = model, placement, recipe
        self._ranges, self._channels, self._shifts = ranges, channels, shifts
        self._rounded = levels
        self._index = GraphIndex(model)
        self._nodes: list[onnx.NodeProto] = []
        self._constants: dict[str, NDArray[Any]] = {}
        self._level_names: dict[str, str] = {}
        self._float_names: dict[str, str] = {}
        self._params: dict[str, QuantParams] = {}
        ends = {placement.outputs[node][0] for node in (*placement.column_outputs, *placement.exact_outputs)}
        self._made_in_8_bits = {name for names in placement.outputs.values() for name in names} - ends

    def write(self) -> QuantisedGraph:
        for name, (levels, scale, zero_point) in self._placement.given.items():
            self._level_names[name], self._float_names[name] = levels, name
            values = self._index.constant(scale), self._index.constant(zero_point)
            assert values[0] is not None and values[1] is not None  # placement took only such
            dtype = "uint8" if values[1].dtype == np.uint8 else "int8"
            self._params[name] = QuantParams(float(values[0]), int(values[1]), dtype)  # type: ignore[arg-type]
        relu_of = self._relus()
        written = set(self._placement.exact_outputs.values())
        for node in self._model.graph.node:
            if node.name in self._placement.folded or node.output[0] in written:
                continue
            if node.name in self._placement.nodes:
                self._quantise(node, relu_of.get(node.name))
            else:
                self._keep(node)
        for name in self._index.outputs:
            if name in self._made_in_8_bits:
                self._dequantised(name)
        return QuantisedGraph(
            self._finish(), {name: (self._level_names[name], self._params[name]) for name in self._level_names}
        )

    def _relus(self) -> dict[str, onnx.NodeProto]:
        """Node -> the ReLU that vanishes into it."""
        found = {}
        for node in self._model.graph.node:
            if node.name in self._placement.folded:
                found[self._index.producer[node.input[0]].name] = node
        return found

    def _keep(self, node: onnx.NodeProto) -> None:
        """A float node reads dequantised values where an 8-bit node made them."""
        copy = _copy(node)
        for position, name in enumerate(copy.input):
            if name in self._made_in_8_bits:
                copy.input[position] = self._dequantised(name)
        self._nodes.append(copy)

    def _quantise(self, node: onnx.NodeProto, relu: onnx.NodeProto | None) -> None:
        if node.name in self._placement.column_outputs:
            self._write_column_convolution(node)
        elif node.name in self._placement.exact_outputs:
            self._write_exact_convolution(node)
        elif node.op_type == STEREO_CORRELATION and self._recipe.quantize_correlation:
            self._write_correlation(node)
        elif self._recipe.integer_moves and moves(node, self._placement.root_of):
            self._write_move(node)
        else:
            copy = _copy(node)
            for position, name in enumerate(activations(node)):
                copy.input[position] = self._dequantised(name)
            if node.op_type == "Conv":
                self._quantise_weights(copy, self._params[node.input[0]].scale)
            for position, name in enumerate(node.output):
                copy.output[position] = self._inner(name)
            self._nodes.append(copy)
            if relu is not None:
                kept = _copy(relu)
                kept.input[0], kept.output[0] = copy.output[0], self._inner(relu.output[0])
                self._nodes.append(kept)
            for name in self._placement.outputs[node.name]:
                self._requantise(self._inner(name), name)

    def _write_correlation(self, node: onnx.NodeProto) -> None:
        inputs = []
        for name in (*node.input, node.output[0]):
            self._settle_params(name)
            scale, zero_point = self._params_as_constants(name)
            inputs += [self._levels(name), scale, zero_point] if name in node.input else [scale, zero_point]
        name = node.output[0]
        self._level_names[name] = f"{name}_q"
        quantised = helper.make_node(
            QLINEAR_STEREO_CORRELATION, inputs, [self._level_names[name]], name=node.name, domain=DOMAIN
        )
        quantised.attribute.append(helper.make_attribute(MAX_DISPARITY, int(attribute(node, MAX_DISPARITY))))
        self._nodes.append(quantised)

    def _write_move(self, node: onnx.NodeProto) -> None:
        names = activations(node)
        levels = [self._levels(name) for name in names]
        for name in node.output:
            self._settle_params(name)
            self._level_names[name] = f"{name}_q"
        if node.op_type == "Relu":  # of a ReLU: its values as they are
            self._level_names[node.output[0]] = levels[0]
            return
        copy = _copy(node)
        copy.input[: len(levels)] = levels
        if node.op_type == "Pad":
            _, zero_point = self._params_as_constants(node.output[0])
            rest = [*copy.input[1:2], zero_point, *copy.input[3:4]]
            del copy.input[1:]
            copy.input.extend(rest)
        for position, name in enumerate(node.output):
            copy.output[position] = self._level_names[name]
        self._nodes.append(copy)

    def _write_column_convolution(self, node: onnx.NodeProto) -> None:
        """The last convolution: a range for each column of the network's output."""
        result, columns = node.output[0], self._placement.column_outputs[node.name]
        if result not in self._channels:
            raise QuantizeError(f"{result}: found no channel extremes; expected them; calibrate for this placement")
        low, high = (extreme.reshape(-1, columns) for extreme in self._channels[result])
        by_column = [
            self._activation_params(float(low[:, column].min()), float(high[:, column].max()))
            for column in range(columns)
        ]
        count = low.size // columns
        steps = np.tile(np.array([item.scale for item in by_column], np.float64), count)
        zero_points = np.tile(np.array([item.zero_point for item in by_column], self._recipe.activation_type), count)

        copy = _copy(node)
        copy.input[0] = self._dequantised(node.input[0])
        middle_level = _MIDDLE[self._recipe.activation_type]
        shift = steps * (zero_points.astype(np.float64) - middle_level)
        self._quantise_weights(copy, self._params[node.input[0]].scale, output_steps=steps, shift=shift)
        copy.output[0] = f"{result}_steps"
        self._nodes.append(copy)
        unit, middle = (
            self._constant("one_step", np.array(1, np.float32)),
            self._constant("middle_level", np.array(middle_level, self._recipe.activation_type)),
        )
        self._add("QuantizeLinear", [copy.output[0], unit, middle], f"{result}_q")
        scale = self._constant(f"{result}_column_scale", steps.astype(np.float32))
        zero_point = self._constant(f"{result}_column_zero_point", zero_points)
        self._add("DequantizeLinear", [f"{result}_q", scale, zero_point], result, axis=1)

    def _write_exact_convolution(self, node: onnx.NodeProto) -> None:
        """The last convolution with channels last, its sums scaled to real numbers and not rounded."""
        result = self._placement.exact_outputs[node.name]
        params = self._settle_params(node.input[0])
        weight, bias = self._weight_and_bias(node)
        scales = self._weight_scales(weight)
        levels = self._weight_levels(node, weight, scales)
        _, zero_point = self._params_as_constants(node.input[0])
        combined = (params.scale * scales.astype(np.float64)).astype(np.float32)
        by_pixel = levels.transpose(2, 3, 1, 0).reshape(-1, len(levels))
        matrix = self._constant(f"{node.name}.matrix_q", np.ascontiguousarray(by_pixel))
        factors = self._constant(f"{node.name}.sum_scale", combined)
        offsets = self._constant(f"{node.name}.sum_offset", bias.astype(np.float32))
        pixels, sums, real, scaled = (f"{node.name}/{part}" for part in ("pixels", "sums", "real_sums", "scaled"))
        window = window_of(node, self._index)
        assert window is not None  # placement took only such
        self._nodes.append(
            helper.make_node("Transpose", [self._levels(node.input[0])], [pixels], name=pixels, perm=[0, 2, 3, 1])
        )
        laid_out, constants, windows = window_nodes(window, pixels, zero_point, name=node.name)
        for constant, value in constants.items():
            self._constant(constant, value)
        self._nodes += [
            *laid_out,
            helper.make_node("MatMulInteger", [windows, matrix, zero_point], [sums], name=node.name),
            helper.make_node("Cast", [sums], [real], name=real, to=onnx.TensorProto.FLOAT),
            helper.make_node("Mul", [real, factors], [scaled], name=scaled),
            helper.make_node("Add", [scaled, offsets], [result], name=f"{node.name}/Add"),
        ]

    def _weight_and_bias(self, node: onnx.NodeProto) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        """A convolution's weight, and its bias with what corrects it."""
        weight = self._index.constant(node.input[1])
        assert weight is not None  # placement took only such
        has_bias = len(node.input) > 2 and node.input[2]
        bias = self._index.constant(node.input[2]) if has_bias else None
        total = np.zeros(weight.shape[0]) if bias is None else bias.astype(np.float64)
        return weight, total + self._shifts.get(node.name, 0.0)

    def _weight_scales(self, weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """(M,) what a level of each output channel's weights stands for."""
        scales = weight_scales(weight, bits=self._recipe.weight_bits, per_channel=self._recipe.weight_per_channel)
        return np.broadcast_to(scales, weight.shape[0])

    def _weight_levels(
        self, node: onnx.NodeProto, weight: NDArray[np.float32], scales: NDArray[np.float32]
    ) -> NDArray[np.int8]:
        """The given levels, but for channels whose scale is another than these were made for."""
        given = self._rounded.get(node.name)
        same = (scales == self._weight_scales(weight)).reshape(-1, *[1] * (weight.ndim - 1))
        if given is not None and same.all():
            return given
        nearest = quantize_weight(weight, scales, bits=self._recipe.weight_bits)
        return nearest if given is None else np.where(same, given, nearest)

    def _quantise_weights(
        self,
        node: onnx.NodeProto,
        input_scale: float,
        *,
        output_steps: NDArray[np.float64] | None = None,
        shift: NDArray[np.float64] | None = None,
    ) -> None:
        """Puts 8-bit weights and a 32-bit bias behind DequantizeLinear, as inputs 1 and 2 of the node.

        Args:
            node: The convolution, changed in place.
            input_scale: Scale of its input.
            output_steps: (M,) what one level of the output stands for, by channel, where it is not one scale.
            shift: (M,) added to the bias.
        """
        weight, total = self._weight_and_bias(node)
        total = total if shift is None else total + shift
        scales = scales_that_hold_bias(self._weight_scales(weight), total, input_scale)
        levels = self._weight_levels(node, weight, scales)
        if output_steps is not None:
            scales = (scales / output_steps).astype(np.float32)
            total = total / output_steps
        bias_levels, bias_scales = quantize_bias(total, input_scale, scales)
        self._put_constant(node, 1, "weight", levels, scales)
        self._put_constant(node, 2, "bias", bias_levels, bias_scales)

    def _put_constant(
        self, node: onnx.NodeProto, position: int, kind: str, levels: NDArray[Any], scales: NDArray[Any]
    ) -> None:
        """Sets an input of the node to dequantised constants with a scale an output channel."""
        names = [
            self._constant(f"{node.name}.{kind}_q", levels),
            self._constant(f"{node.name}.{kind}_scale", scales),
            self._constant(f"{node.name}.{kind}_zero_point", np.zeros(len(scales), levels.dtype)),
        ]
        self._add("DequantizeLinear", names, f"{node.name}.{kind}_dq", axis=0)
        del node.input[position:]
        node.input.append(f"{node.name}.{kind}_dq")

    def _settle_params(self, name: str) -> QuantParams:
        """Scale and zero point of a tensor: those of its root."""
        if name not in self._params:
            root = self._placement.root_of[name]
            if root != name:
                self._params[name] = self._settle_params(root)
            elif root not in self._ranges:
                raise QuantizeError(f"{root}: found no range; expected one; calibrate for this placement")
            else:
                low, high = self._ranges[root]
                self._params[name] = self._activation_params(low, high)
        return self._params[name]

    def _activation_params(self, low: float, high: float) -> QuantParams:
        """Scale and zero point of a range, as the recipe wants them."""
        return activation_params(
            low, high, dtype=self._recipe.activation_type, symmetric=self._recipe.activation_symmetric
        )

    def _levels(self, name: str) -> str:
        """The 8-bit tensor of a float one, quantised now where it is float so far."""
        if name not in self._level_names:
            self._requantise(name, name)
        return self._level_names[name]

    def _requantise(self, real: str, name: str) -> None:
        self._settle_params(name)
        self._level_names[name] = f"{name}_q"
        self._add("QuantizeLinear", [real, *self._params_as_constants(name)], self._level_names[name])

    def _dequantised(self, name: str) -> str:
        """The float tensor that the 8-bit one of ``name`` stands for."""
        if name not in self._float_names:
            levels = self._levels(name)
            is_end = name in self._index.outputs and name in self._made_in_8_bits
            self._float_names[name] = name if is_end else f"{name}_dq"
            self._add("DequantizeLinear", [levels, *self._params_as_constants(name)], self._float_names[name])
        return self._float_names[name]

    def _inner(self, name: str) -> str:
        """Name of a float tensor before it is quantised; an output's own name is for what comes behind."""
        return f"{name}_float" if name in self._index.outputs else name

    def _params_as_constants(self, name: str) -> tuple[str, str]:
        params, root = self._settle_params(name), self._placement.root_of[name]
        if root in self._placement.given:
            return self._placement.given[root][1], self._placement.given[root][2]
        return (
            self._constant(f"{root}_scale", np.array(params.scale, np.float32)),
            self._constant(f"{root}_zero_point", np.array(params.zero_point, params.dtype)),
        )

    def _constant(self, name: str, value: NDArray[Any]) -> str:
        self._constants.setdefault(name, value)
        return name

    def _add(self, op_type: str, inputs: list[str], output: str, axis: int | None = None) -> None:
        node = helper.make_node(op_type, inputs, [output], name=f"{output}/{op_type}")
        if axis is not None:
            node.attribute.append(helper.make_attribute("axis", axis))
        self._nodes.append(node)

    def _finish(self) -> onnx.ModelProto:
        result = onnx.ModelProto()
        result.CopyFrom(self._model)
        del result.graph.node[:]
        result.graph.node.extend(self._nodes)
        result.graph.initializer.extend(numpy_helper.from_array(value, name) for name, value in self._constants.items())
        if any(node.op_type == QLINEAR_STEREO_CORRELATION for node in self._nodes):
            opset = next(item.version for item in result.opset_import if item.domain == "")
            result.functions.append(qlinear_stereo_correlation_function(opset))
        prune(result)
        result.producer_name = _PRODUCER
        return result


def _copy(node: onnx.NodeProto) -> onnx.NodeProto:
    copy = onnx.NodeProto()
    copy.CopyFrom(node)
    return copy
