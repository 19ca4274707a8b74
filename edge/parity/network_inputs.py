"""What reaches a graph's first convolution, in levels of a pixel.

A float model normalises pixels first; an INT8 one may read them as they are, the normalisation folded into its first
convolution. Expressed in levels (0 to 255) both can be held against one reference. The graph is cut behind the values
that are wanted, so that a look at them costs little.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray

from edge.parity.reference_pixels import Levels, levels_of
from quantize.graph import GraphIndex, attribute, prune
from runtime.contracts.manifest import Normalisation
from runtime.session import open_session


@dataclass(frozen=True, slots=True)
class FirstConvolution:
    """A convolution that reads the images, and how.

    Attributes:
        node: its name; tensor: what it reads; output: what it makes.
        views: graph inputs behind the rows of ``tensor``'s batch, in order.
        zero_point: of pixels that are read as they are, ``tensor`` being the pixel minus it; None where pixels are
            normalised.
        quantised: whether normalised pixels were rounded to 8 bits before they are read.
    """

    node: str
    tensor: str
    output: str
    views: tuple[str, ...]
    zero_point: int | None
    quantised: bool


def first_convolutions(model: onnx.ModelProto) -> list[FirstConvolution]:
    """The convolutions that read the images, in the order of the graph; empty where none does without another before.

    Args:
        model: float, or INT8 with DequantizeLinear before its convolutions.
    """
    index = GraphIndex(model)
    found = []
    for node in model.graph.node:
        if node.op_type != "Conv":
            continue
        path = _path(index, node.input[0])
        if path is not None:
            views, operators = path
            raw = "DequantizeLinear" in operators and operators <= {"DequantizeLinear", "Concat"}
            point = index.constant(index.producer[node.input[0]].input[2]) if raw else None
            zero_point = int(point) if point is not None else 0 if raw else None
            found.append(
                FirstConvolution(
                    node.name, node.input[0], node.output[0], views, zero_point, "QuantizeLinear" in operators
                )
            )
    return found


def _path(index: GraphIndex, tensor: str) -> tuple[tuple[str, ...], set[str]] | None:
    """Graph inputs behind a tensor's batch, and the operators between; None behind a convolution or a constant."""
    if tensor in index.inputs:
        return (tensor,), set()
    node = index.producer.get(tensor)
    if node is None or node.op_type == "Conv" or node.domain not in ("", "ai.onnx"):
        return None
    sources = [name for name in node.input if name and index.constant(name) is None]
    paths = [_path(index, name) for name in sources]
    if not paths or any(path is None for path in paths):
        return None
    if len(paths) > 1 and (node.op_type != "Concat" or attribute(node, "axis", 0) != 0):
        return None
    known = [path for path in paths if path is not None]
    return tuple(name for names, _ in known for name in names), {node.op_type}.union(*(kinds for _, kinds in known))


def values_at(model: onnx.ModelProto, tensors: list[str], feeds: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Values of inner float tensors on one set of feeds; the graph behind them is cut away, nothing in it is fused.

    Raises:
        SessionError: the feeds do not fit the graph.
    """
    cut = onnx.ModelProto()
    cut.CopyFrom(model)
    del cut.graph.output[:]
    names = list(dict.fromkeys(tensors))
    for name in names:
        cut.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    prune(cut)
    with open_session(cut.SerializeToString(), optimize=False, name="graph up to its first convolution") as session:
        wanted = {item.name for item in session.inputs}
        fed = {name: value for name, value in feeds.items() if name in wanted}
        return dict(zip(names, session.run(fed, outputs=names), strict=True))


def levels_read(convolution: FirstConvolution, values: NDArray[Any], normalisation: Normalisation) -> dict[str, Levels]:
    """View name -> (3, H, W) levels that a first convolution reads.

    Args:
        convolution: which.
        values: its ``tensor``.
        normalisation: of the manifest; undone where pixels were normalised.
    """
    if convolution.zero_point is not None:
        levels = values.astype(np.float64) + convolution.zero_point
    else:
        levels = levels_of(values, normalisation)
    return {name: levels[row] for row, name in enumerate(convolution.views)}
