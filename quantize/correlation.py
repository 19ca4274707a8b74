"""``QLinearStereoCorrelation``: its body in standard operators, which every file with such a node carries.

The body gives the bits of the NumPy oracle and of the native kernel: integer accumulation, the multiplier
computed in double before it becomes one float, rounding half to even, saturation. Nothing about a node is
baked in; types, shapes and ``max_disparity`` are read at run time.

The idea, and the statements that read the band beside the diagonal, are those of the float body
(`export.function_body`), here of integers: the right view is padded with columns of its zero point, which contribute
nothing.

The right view is turned into unsigned bytes first, int8 levels and their zero point lifted by 128: processors without
8-bit dot products add two products in 16 bits where the second operand is signed, and these saturate.
"""

from __future__ import annotations

import onnx
import onnx.parser

from export.function_body import BAND, SIZES
from runtime.contracts.correlation import DOMAIN, MAX_DISPARITY, QLINEAR_STEREO_CORRELATION

_BODY = (
    """
<domain: "{domain}", opset_import: ["" : {opset}]>
{name} <{attribute}> (left, left_scale, left_zero_point, right, right_scale, right_zero_point,
                      output_scale, output_zero_point) => (volume)
{{"""
    + SIZES
    + """
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
"""
    + BAND
    + """
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
)


def qlinear_stereo_correlation_function(opset_version: int) -> onnx.FunctionProto:
    """Makes the function for a model of one opset.

    Args:
        opset_version: The model's version of the standard operators, 18 or more.

    Returns:
        The local function ``edge.stereo::QLinearStereoCorrelation``, to be put among the model's functions.
    """
    text = _BODY.format(domain=DOMAIN, opset=opset_version, name=QLINEAR_STEREO_CORRELATION, attribute=MAX_DISPARITY)
    return onnx.parser.parse_function(text)
