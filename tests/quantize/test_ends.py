"""Last convolutions: which are products over windows, and that their sums reach the output unrounded."""

from __future__ import annotations

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from calib.ranges import observe  # noqa: E402
from quantize.bias_correction import bias_shifts  # noqa: E402
from quantize.graph import GraphIndex, name_nodes  # noqa: E402
from quantize.pixels import fold_pixels  # noqa: E402
from quantize.placement import place  # noqa: E402
from quantize.qdq import quantise_graph  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from runtime.profile import int8_share, profile_model  # noqa: E402
from runtime.session import open_session  # noqa: E402

FLOAT_ROUNDING = 1e-6
"""Relative to the largest value: sums below 2^24 are exact in float32, one product and one sum are rounded."""
LAST = "box_deltas.last"
RECIPE = recipe_for_target("x86-vnni")


def one_by_one(model: onnx.ModelProto, name: str = LAST) -> onnx.NodeProto:
    """Makes a 3x3 convolution of the toy a 1x1 one: the middle of its kernel."""
    index = GraphIndex(model)
    node = next(item for item in model.graph.node if item.name == name)
    tensor = index.initializers[node.input[1]]
    weight = onnx.numpy_helper.to_array(tensor)
    tensor.CopyFrom(onnx.numpy_helper.from_array(np.ascontiguousarray(weight[:, :, 1:2, 1:2]), tensor.name))
    del node.attribute[:]
    return node


@pytest.fixture(params=[1, 3])
def written(request, toy_model, toy_feeds):
    if request.param == 1:
        one_by_one(toy_model)
    name_nodes(toy_model)
    model = fold_pixels(toy_model).model
    placement = place(model, RECIPE)
    seen = observe(model, lambda: toy_feeds[:4], tensors=placement.observed)
    graph = quantise_graph(model, placement, RECIPE, ranges=seen.ranges("minmax"), channels=seen.channels)
    return model, placement, graph, request.param


@pytest.mark.parametrize(
    ("attribute", "value"),
    [
        ("strides", [2, 2]),  # leaves pixels out
        ("dilations", [2, 2]),
        ("auto_pad", "SAME_UPPER"),
    ],
)
def test_uneven_windows_are_no_matrix_products(toy_model, attribute: str, value: object) -> None:
    node = one_by_one(toy_model)
    node.attribute.append(onnx.helper.make_attribute(attribute, value))
    name_nodes(toy_model)
    placement = place(toy_model, RECIPE)
    assert LAST not in placement.exact_outputs
    assert placement.column_outputs == {LAST: 12}
    assert placement.observed_channels == (LAST,)


def test_an_end_is_exact_and_needs_no_range(written) -> None:
    _, placement, graph, _ = written
    assert placement.exact_outputs == {LAST: "box_deltas.turned", "cls_logits.last": "cls_logits.turned"}
    assert not placement.column_outputs
    assert not placement.observed_channels
    operators = {node.name: node.op_type for node in graph.model.graph.node}
    assert operators[LAST] == "MatMulInteger"
    onnx.checker.check_model(graph.model, full_check=False)


def test_given_back_to_float_it_is_a_convolution_again(written) -> None:
    model, *_ = written
    placement = place(model, RECIPE, [LAST])
    assert LAST not in placement.exact_outputs
    assert placement.kept_float[LAST] == "given back to float"


def test_the_output_is_the_scaled_integer_sum(written, toy_feeds) -> None:
    model, _, graph, size = written
    source = next(node for node in model.graph.node if node.name == LAST).input[0]
    levels_name, params = graph.tensors[source]
    copy = onnx.ModelProto.FromString(graph.model.SerializeToString())
    copy.graph.output.append(onnx.helper.make_tensor_value_info(levels_name, onnx.TensorProto.UINT8, None))
    with open_session(copy.SerializeToString()) as session:
        output, levels = session.run(toy_feeds[6], outputs=["box_deltas", levels_name])
    stored = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.model.graph.initializer}
    kernel = stored[f"{LAST}.matrix_q"].astype(np.int64).reshape(size, size, levels.shape[1], -1)
    margin = size // 2
    values = np.pad(levels.astype(np.int64) - params.zero_point, ((0, 0), (0, 0), (margin, margin), (margin, margin)))
    windows = np.lib.stride_tricks.sliding_window_view(values, (size, size), axis=(2, 3))
    sums = np.einsum("bchwyx,yxcm->bhwm", windows, kernel)
    expected = sums * stored[f"{LAST}.sum_scale"].astype(np.float64) + stored[f"{LAST}.sum_offset"]
    expected = expected.reshape(output.shape)
    assert np.unique(output).size > 256  # no 8-bit tensor holds so many values
    np.testing.assert_allclose(output, expected, rtol=0, atol=FLOAT_ROUNDING * np.abs(expected).max())


def test_its_weights_stay_where_they_were(written) -> None:
    """Each pixel of a window meets the weights that the convolution has for it, to half a step."""
    model, _, graph, _ = written
    node = next(node for node in model.graph.node if node.name == LAST)
    weight = GraphIndex(model).constant(node.input[1])
    stored = {tensor.name: onnx.numpy_helper.to_array(tensor) for tensor in graph.model.graph.initializer}
    source_scale = graph.tensors[node.input[0]][1].scale
    count, channels, *size = weight.shape
    matrix = stored[f"{LAST}.matrix_q"].reshape(*size, channels, count)
    steps = stored[f"{LAST}.sum_scale"] / source_scale
    found = matrix.transpose(3, 2, 0, 1) * steps.reshape(-1, 1, 1, 1)
    assert (np.abs(found - weight) <= 0.501 * steps.reshape(-1, 1, 1, 1)).all()


def test_the_runtime_computes_it_in_8_bits(written, toy_feeds) -> None:
    _, _, graph, size = written
    nodes = profile_model(graph.model.SerializeToString(), toy_feeds[:1])
    product = next(node for node in nodes if node.name == LAST)
    assert product.operator == "MatMulInteger"
    assert product.multiply_adds == 2 * 4 * 16 * size * size * 48 * 12  # cells x channels x anchors x columns
    assert int8_share(nodes) == 1.0


def test_its_bias_is_corrected_like_any_other(written, toy_feeds) -> None:
    model, placement, graph, _ = written
    shifts = bias_shifts(model, graph.model, placement, toy_feeds[:2])
    assert shifts[LAST].shape == (48 * 12,)
    assert np.abs(shifts[LAST]).max() > 0


@pytest.mark.parametrize("target", ["tensorrt", "openvino"])
def test_runtimes_that_fuse_pairs_keep_their_convolution(toy_model, target: str) -> None:
    one_by_one(toy_model)
    name_nodes(toy_model)
    assert not place(toy_model, recipe_for_target(target)).exact_outputs
