"""The body of ``StereoCorrelation`` in standard operators, which every exported file carries.

It runs wherever the native library does not. Nothing about a node is baked in: ``max_disparity`` is read
from the node's attribute and every extent from its inputs at run time, so that one body serves nodes of
different D and images of any size.

The idea: for one image row the scores of all pairs of columns are one matrix product, ``left^T right``,
which ONNX Runtime does at full speed; the volume is the band of it beside the diagonal. The right view is
padded with D - 1 zero columns on its left, so the band of row x starts at column x. To read a band as a
rectangle, the rows of length L = W + D - 1 are laid end to end, W zeros are appended, and the whole is cut
into W rows of L + 1: row x has moved x columns to the left. Its first D columns are the disparities D - 1
.. 0.
"""

from __future__ import annotations

import onnx
import onnx.parser

from runtime.contracts.correlation import DOMAIN, MAX_DISPARITY, STEREO_CORRELATION

_BODY = """
<domain: "{domain}", opset_import: ["" : {opset}]>
{name} <{attribute}> (left, right) => (volume)
{{
    zero = Constant <value_ints: ints = [0]> ()
    one = Constant <value_ints: ints = [1]> ()
    minus_one = Constant <value_ints: ints = [-1]> ()
    last_axis = Constant <value_ints: ints = [3]> ()
    before_first = Constant <value_ints: ints = [-9223372036854775807]> ()
    disparities_scalar = Constant <value_int: int = @{attribute}> ()
    disparities = Reshape (disparities_scalar, one)
    largest = Sub (disparities, one)

    batch = Shape <start: int = 0, end: int = 1> (left)
    channels = Shape <start: int = 1, end: int = 2> (left)
    height = Shape <start: int = 2, end: int = 3> (left)
    width = Shape <start: int = 3, end: int = 4> (left)
    skewed_width = Add (width, disparities)
    row_shape = Concat <axis: int = 0> (batch, height, minus_one)
    skewed_shape = Concat <axis: int = 0> (batch, height, width, skewed_width)

    before = Concat <axis: int = 0> (zero, zero, zero, largest, zero, zero, zero, zero)
    right_padded = Pad (right, before)
    left_columns = Transpose <perm: ints = [0, 2, 3, 1]> (left)
    right_rows = Transpose <perm: ints = [0, 2, 1, 3]> (right_padded)
    all_pairs = MatMul (left_columns, right_rows)

    end_to_end = Reshape (all_pairs, row_shape)
    behind = Concat <axis: int = 0> (zero, zero, zero, zero, zero, width)
    with_tail = Pad (end_to_end, behind)
    skewed = Reshape (with_tail, skewed_shape)
    band = Slice (skewed, largest, before_first, last_axis, minus_one)

    sums = Transpose <perm: ints = [0, 3, 1, 2]> (band)
    channel_count = CastLike (channels, sums)
    volume = Div (sums, channel_count)
}}
"""


def stereo_correlation_function(opset_version: int) -> onnx.FunctionProto:
    """Makes the function for a model of one opset.

    Args:
        opset_version: The model's version of the standard operators, 18 or more.

    Returns:
        The local function ``edge.stereo::StereoCorrelation``, to be put among the model's functions.
    """
    text = _BODY.format(domain=DOMAIN, opset=opset_version, name=STEREO_CORRELATION, attribute=MAX_DISPARITY)
    return onnx.parser.parse_function(text)
