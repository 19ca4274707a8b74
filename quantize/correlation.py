"""``QLinearStereoCorrelation``: its body in standard operators, which every file with such a node carries.

The body gives the bits of the NumPy oracle and of the native kernel: integer accumulation, the multiplier
computed in double before it becomes one float, rounding half to even, saturation. Nothing about a node is
baked in; types, shapes and ``max_disparity`` are read at run time.

The idea is that of the float body: for one image row the scores of all pairs of columns are one matrix
product, here of integers, and the volume is the band beside its diagonal. The right view is padded with D -
1 columns of its zero point on its left, which contribute nothing, so that the band of row x starts at
column x. To read a band as a rectangle, the rows of length L = W + D - 1 are laid end to end, W zeros are
appended, and the whole is cut into W rows of L + 1: row x has moved x columns to the left, and its first D
columns are the disparities D - 1 .. 0.

The right view is turned into unsigned bytes first, int8 levels and their zero point lifted by 128: processors without
8-bit dot products add two products in 16 bits where the second operand is signed, and these saturate.
"""

from __future__ import annotations

import onnx
import onnx.parser

from runtime.contracts.correlation import DOMAIN, MAX_DISPARITY, QLINEAR_STEREO_CORRELATION

_BODY = """
<domain: "{domain}", opset_import: ["" : {opset}]>
{name} <{attribute}> (left, left_scale, left_zero_point, right, right_scale, right_zero_point,
                      output_scale, output_zero_point) => (volume)
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

    one_step = Constant <value_float: float = 1.0> ()
    beyond_all = Constant <value_float: float = 1000.0> ()
    top = QuantizeLinear (beyond_all, one_step, right_zero_point)
    top_real = Cast <to: int = 1> (top)
    largest_byte = Constant <value_float: float = 255.0> ()
    lift = Sub (largest_byte, top_real)
    right_real = Cast <to: int = 1> (right)
    right_lifted = Add (right_real, lift)
    right_bytes = Cast <to: int = 2> (right_lifted)
    right_zero_real = Cast <to: int = 1> (right_zero_point)
    right_zero_lifted = Add (right_zero_real, lift)
    right_zero_byte = Cast <to: int = 2> (right_zero_lifted)

    before = Concat <axis: int = 0> (zero, zero, zero, largest, zero, zero, zero, zero)
    right_padded = Pad (right_bytes, before, right_zero_byte)
    left_columns = Transpose <perm: ints = [0, 2, 3, 1]> (left)
    right_rows = Transpose <perm: ints = [0, 2, 1, 3]> (right_padded)
    all_pairs = MatMulInteger (left_columns, right_rows, left_zero_point, right_zero_byte)

    end_to_end = Reshape (all_pairs, row_shape)
    behind = Concat <axis: int = 0> (zero, zero, zero, zero, zero, width)
    with_tail = Pad (end_to_end, behind)
    skewed = Reshape (with_tail, skewed_shape)
    band = Slice (skewed, largest, before_first, last_axis, minus_one)
    sums = Transpose <perm: ints = [0, 3, 1, 2]> (band)

    channel_count = Cast <to: int = 11> (channels)
    left_scale_64 = Cast <to: int = 11> (left_scale)
    right_scale_64 = Cast <to: int = 11> (right_scale)
    output_scale_64 = Cast <to: int = 11> (output_scale)
    product = Mul (left_scale_64, right_scale_64)
    divisor = Mul (channel_count, output_scale_64)
    multiplier_64 = Div (product, divisor)
    multiplier = Cast <to: int = 1> (multiplier_64)

    real = Cast <to: int = 1> (sums)
    steps = Mul (real, multiplier)
    volume = QuantizeLinear (steps, one_step, output_zero_point)
}}
"""


def qlinear_stereo_correlation_function(opset_version: int) -> onnx.FunctionProto:
    """Makes the function for a model of one opset.

    Args:
        opset_version: The model's version of the standard operators, 18 or more.

    Returns:
        The local function ``edge.stereo::QLinearStereoCorrelation``, to be put among the model's functions.
    """
    text = _BODY.format(domain=DOMAIN, opset=opset_version, name=QLINEAR_STEREO_CORRELATION, attribute=MAX_DISPARITY)
    return onnx.parser.parse_function(text)
