"""The finished graph: one custom node a correlation, its function beside it, no trace of where it was made."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from runtime.session import open_session

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
from export.errors import ExportError  # noqa: E402
from export.passes import custom_nodes, finish, strip_notes  # noqa: E402
from export.to_onnx import to_onnx  # noqa: E402
from export.views import FromPixels  # noqa: E402

pytestmark = pytest.mark.torch

OUTPUTS = ("cls_logits", "box_deltas")
FLOAT32_NETWORK = 1e-5
"""Torch and ONNX Runtime sum in another order; outputs are of order 1."""


@pytest.fixture
def model(exported: bytes):  # type: ignore[no-untyped-def]
    return onnx.load_from_string(exported)


def test_one_node_a_correlation_and_one_function(model) -> None:  # type: ignore[no-untyped-def]
    assert custom_nodes(model) == {"StereoCorrelation": 2}
    nodes = [node for node in model.graph.node if node.domain == "edge.stereo"]
    assert [onnx.helper.get_node_attr_value(node, "max_disparity") for node in nodes] == [7, 3]
    assert [(function.domain, function.name) for function in model.functions] == [("edge.stereo", "StereoCorrelation")]
    assert {item.domain: item.version for item in model.opset_import} == {"": 18, "edge.stereo": 1}
    assert model.ir_version == 10


def test_batch_norm_is_folded_and_weights_are_shared(model) -> None:  # type: ignore[no-untyped-def]
    kinds = [node.op_type for node in model.graph.node]
    assert "BatchNormalization" not in kinds and kinds.count("Conv") == 4


def test_names_tell_the_module(model) -> None:  # type: ignore[no-untyped-def]
    names = {node.name for node in model.graph.node}
    assert {"stem.0/Conv", "fine/StereoCorrelation", "coarse/StereoCorrelation", "boxes/Conv"} <= names
    assert len(names) == len(model.graph.node)
    assert [item.name for item in model.graph.input] == ["left", "right"]
    assert tuple(item.name for item in model.graph.output) == OUTPUTS


def test_no_path_and_no_note_is_left(model) -> None:  # type: ignore[no-untyped-def]
    content = model.SerializeToString()
    here = Path(__file__).resolve()
    for trace in (str(here.parent), str(Path(torch.__file__).parent), ".py", "stack_trace", "pkg.torch", "TwoViews"):
        assert trace.encode() not in content


def test_is_one_file(model, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    onnx.save(model, tmp_path / "model.onnx")
    assert [path.name for path in tmp_path.iterdir()] == ["model.onnx"]
    with open_session(tmp_path / "model.onnx") as session:
        assert [item.shape for item in session.outputs] == [(1, 96, 2), (1, 96, 12)]


@pytest.mark.parametrize("use_native", [True, False])
def test_computes_what_torch_computes(two_view_network, views, model, use_native: bool) -> None:  # type: ignore[no-untyped-def]
    with torch.no_grad():
        expected = two_view_network(*views.values())
    with open_session(model.SerializeToString(), use_native=use_native) as session:
        found = session.run({name: view.numpy() for name, view in views.items()})
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(b, a.numpy(), rtol=0, atol=FLOAT32_NETWORK)


def test_pixels_are_normalised_inside(two_view_network) -> None:  # type: ignore[no-untyped-def]
    mean, std = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
    wrapped = FromPixels(two_view_network, mean=mean, std=std)
    rng = np.random.default_rng(3)
    pixels = {name: rng.integers(0, 256, (1, 3, 32, 96), dtype=np.uint8) for name in ("left", "right")}
    model = to_onnx(wrapped, {name: torch.from_numpy(view) for name, view in pixels.items()}, OUTPUTS)
    assert "stem.0/Conv" in {node.name for node in model.graph.node}  # no "network." before it
    column = (1, 3, 1, 1)
    normalised = [
        torch.from_numpy((view.astype(np.float64) / 255 - np.reshape(mean, column)) / np.reshape(std, column)).float()
        for view in pixels.values()
    ]
    with torch.no_grad():
        expected = two_view_network(*normalised)
    with open_session(model.SerializeToString()) as session:
        assert [item.dtype for item in session.inputs] == [np.uint8, np.uint8]
        found = session.run(pixels)
    for a, b in zip(expected, found, strict=True):
        np.testing.assert_allclose(b, a.numpy(), rtol=0, atol=FLOAT32_NETWORK)


def test_one_tensor_given_twice_stays_two_inputs(two_view_network, views) -> None:  # type: ignore[no-untyped-def]
    model = to_onnx(two_view_network, {"left": views["left"], "right": views["left"]}, OUTPUTS)
    used = {name for node in model.graph.node for name in node.input}
    assert {"left", "right"} <= used


def test_mono_network_has_one_input_and_no_function(two_view_network, views) -> None:  # type: ignore[no-untyped-def]
    model = to_onnx(two_view_network.stem, {"left": views["left"]}, ["features"])
    assert [item.name for item in model.graph.input] == ["left"]
    assert not model.functions and [item.domain for item in model.opset_import] == [""]


def test_leaves_the_module_as_it_was(two_view_network, views) -> None:  # type: ignore[no-untyped-def]
    two_view_network.train()
    two_view_network.stem.eval()  # a frozen part
    before = {name: value.clone() for name, value in two_view_network.state_dict().items()}
    to_onnx(two_view_network, views, OUTPUTS)
    assert two_view_network.training and not two_view_network.stem.training
    assert all(torch.equal(before[name], value) for name, value in two_view_network.state_dict().items())


def test_a_module_that_cannot_be_exported_is_one_line(views) -> None:  # type: ignore[no-untyped-def]
    class Branches(torch.nn.Module):
        def forward(self, left, right):  # type: ignore[no-untyped-def]
            return left if left.sum() > 0 else right

    with pytest.raises(ExportError, match="Branches: found that torch cannot export it") as error:
        to_onnx(Branches(), views, ["out"])
    assert "\n" not in str(error.value)


def test_a_pass_that_loses_a_custom_node_is_an_error(model, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    def lossy(graph):  # type: ignore[no-untyped-def]
        return onnx.inliner.inline_local_functions(graph)

    monkeypatch.setattr("export.passes.simplify", lossy)
    with pytest.raises(ExportError, match="as before"):
        finish(model)


def test_strip_reaches_every_part(model) -> None:  # type: ignore[no-untyped-def]
    for part in (model, model.graph, model.graph.node[0], model.graph.initializer[0], model.functions[0].node[0]):
        part.doc_string = "made by someone"
        part.metadata_props.add(key="where", value="with someone")
    assert b"someone" not in strip_notes(model).SerializeToString()
