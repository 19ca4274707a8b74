"""The convolutions that end a network: what they write is read as columns of numbers, by the caller alone.

Rounding the last numbers to 8 bits would be the one rounding that nothing behind it averages out: class scores of
neighbouring anchors tie, and suppression then keeps another box. A convolution of stride 1 is a matrix product over the
window of each pixel, and a product of 8-bit integers has a 32-bit sum, which times a scale a channel is the output
itself (`Placement.exact_outputs`): same multiply-adds, no QuantizeLinear, and the transposition to channels last moves
bytes instead of floats. Windows of more than a pixel are laid out side by side before, as bytes, too; ONNX Runtime's
operator for such sums, ConvInteger, is four times slower than its QLinearConv. Other convolutions, and all where a
recipe wants it so, get a range for each column (`Placement.column_outputs`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper

from quantize.graph import GraphIndex, attribute

_TO_THE_END = int(np.iinfo(np.int64).max)


@dataclass(frozen=True, slots=True)
class Window:
    """What a convolution of stride 1 reads for a pixel.

    Attributes:
        rows, columns: of pixels.
        margins: pixels of padding above, left, below and right of the image.
    """

    rows: int
    columns: int
    margins: tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class NetworkEnd:
    """A last convolution.

    Attributes:
        columns: of the network's output; channel c is column c modulo columns.
        channels_last: tensor behind its Transpose, [B, H, W, M].
        is_product: whether it is a matrix product over windows, see `window_of`.
    """

    columns: int
    channels_last: str
    is_product: bool


def network_ends(
    taken: Mapping[str, onnx.NodeProto], *, index: GraphIndex, outputs: Mapping[str, tuple[str, ...]]
) -> dict[str, NetworkEnd]:
    """Convolutions that end the 8-bit part: Conv, Transpose to channels last, Reshape to an output [B, N, columns].

    Args:
        taken: Nodes that compute in 8 bits, by name.
        index: Of the float graph.
        outputs: Of each node, behind the ReLU that vanishes into it.
    """
    read = {name for node in taken.values() for name in node.input}
    ends: dict[str, NetworkEnd] = {}
    sizes = {item.name: item.type.tensor_type.shape.dim for item in index.model.graph.output}
    for name, node in taken.items():
        result = outputs[name][0]
        if node.op_type != "Conv" or result in read or result != node.output[0]:
            continue
        transpose = index.only_consumer(result)
        if transpose is None or transpose.op_type != "Transpose":
            continue
        reshape = index.only_consumer(transpose.output[0])
        if reshape is None or reshape.op_type != "Reshape" or reshape.output[0] not in sizes:
            continue
        dims = sizes[reshape.output[0]]
        permutation = list(attribute(transpose, "perm", []))
        if len(dims) == 3 and dims[2].dim_value > 0 and permutation == [0, 2, 3, 1]:
            ends[name] = NetworkEnd(int(dims[2].dim_value), transpose.output[0], window_of(node, index) is not None)
    return ends


def window_of(node: onnx.NodeProto, index: GraphIndex) -> Window | None:
    """The window of a convolution; None where it leaves pixels out, or reads some channels or pixels only."""
    weight = index.constant(node.input[1])
    padding = attribute(node, "auto_pad", b"NOTSET")
    even = all(np.all(np.asarray(attribute(node, name, [1])) == 1) for name in ("strides", "dilations", "group"))
    if weight is None or weight.ndim != 4 or not even or padding not in (b"NOTSET", b"VALID"):
        return None
    above, left, below, right = attribute(node, "pads", [0, 0, 0, 0]) if padding == b"NOTSET" else (0, 0, 0, 0)
    return Window(*weight.shape[2:], (above, left, below, right))


def window_nodes(
    window: Window, pixels: str, zero_point: str, *, name: str
) -> tuple[list[onnx.NodeProto], dict[str, NDArray[np.int64]], str]:
    """Lays the pixels that each sum reads side by side: [B, H, W, C] to [B, H', W', rows x columns x C].

    Args:
        window: What is read.
        pixels: Name of the 8-bit tensor.
        zero_point: Name of its zero point, which stands beyond the image.
        name: Of the convolution, before all names that are made.

    Returns:
        Nodes, constants by name, and the name of the result; nothing and ``pixels`` where a window is a pixel.
    """
    nodes: list[onnx.NodeProto] = []
    constants: dict[str, NDArray[np.int64]] = {}

    def constant(part: str, values: list[int]) -> str:
        constants[f"{name}.{part}"] = np.array(values, np.int64)
        return f"{name}.{part}"

    def add(operator: str, inputs: list[str], part: str, **attributes: int) -> str:
        output = f"{name}/{part}"
        nodes.append(helper.make_node(operator, inputs, [output], name=output, **attributes))
        return output

    if any(window.margins):
        above, left, below, right = window.margins
        margins = constant("margins", [0, above, left, 0, 0, below, right, 0])
        pixels = add("Pad", [pixels, margins, zero_point], "padded")
    if window.rows == window.columns == 1:
        return nodes, constants, pixels
    axes = constant("window_axes", [1, 2])
    shifted = []
    for row, column in np.ndindex(window.rows, window.columns):
        begin = constant(f"from_{row}_{column}", [row, column])
        end = constant(
            f"to_{row}_{column}", [row - window.rows + 1 or _TO_THE_END, column - window.columns + 1 or _TO_THE_END]
        )
        shifted.append(add("Slice", [pixels, begin, end, axes], f"pixels_{row}_{column}"))
    return nodes, constants, add("Concat", shifted, "windows", axis=3)
