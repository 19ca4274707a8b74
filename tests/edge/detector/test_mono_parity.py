"""The monocular network against recordings of the official code's plain head (reduced input size)."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.deformable import ONNX_OPSET, DeformableConv2d, deformable_conv2d  # noqa: E402
from edge.detector.mono_network import MonoDetector  # noqa: E402
from edge.detector.presets import preset  # noqa: E402
from edge.detector.weights import load_weights  # noqa: E402
from runtime.session import open_session  # noqa: E402

pytestmark = pytest.mark.torch

CASE = "deform_conv__"
ROUNDING_FACTOR = 10.0
# The mono recordings hold no float64 run; the stereo ones of the same size and kind of layer do (net_96x320).
ROUNDING_LIKE = {"layer1": "left_s4", "features_s16": "left_s16", "cls_out": "cls_out", "deform_conv": "reg_convbnrelu",
                 "reg_out": "reg_out"}  # fmt: skip
GATHER_ROUNDING = 1e-5  # float32 sums of 72 products of order 1, positions through a normalised grid


def load_module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def by_hand(x: NDArray[np.float64], layer: DeformableConv2d, predicted: NDArray[np.float64]) -> NDArray[np.float64]:
    """The deformable convolution place by place."""
    weight, bias = layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy()
    _, channels, height, width = x.shape
    out = np.zeros((1, weight.shape[0], height, width))
    for y, column in np.ndindex(height, width):
        total = bias.copy()
        for tap in range(9):
            place_y = y + tap // 3 - 1 + predicted[0, 2 * tap, y, column]
            place_x = column + tap % 3 - 1 + predicted[0, 2 * tap + 1, y, column]
            read = np.zeros(channels)
            for near_y in (int(np.floor(place_y)), int(np.floor(place_y)) + 1):
                for near_x in (int(np.floor(place_x)), int(np.floor(place_x)) + 1):
                    if 0 <= near_y < height and 0 <= near_x < width:
                        share = (1 - abs(place_y - near_y)) * (1 - abs(place_x - near_x))
                        read += share * x[0, :, near_y, near_x]
            mask = 1 / (1 + np.exp(-predicted[0, 18 + tap, y, column]))
            total += mask * (weight[:, :, tap // 3, tap % 3] @ read)
        out[0, :, y, column] = total
    return out


def restless_layer(channels: int = 4, out: int = 3) -> DeformableConv2d:
    """A layer whose offsets reach several cells, also beyond the image."""
    torch.manual_seed(4)
    layer = DeformableConv2d(channels, out)
    torch.nn.init.normal_(layer.conv_offset.weight, std=0.4)
    torch.nn.init.normal_(layer.conv_offset.bias, std=1.5)
    torch.nn.init.normal_(layer.bias)
    return layer


def test_fresh_layer_is_half_a_convolution() -> None:
    layer, x = DeformableConv2d(4, 3), torch.randn(2, 4, 5, 6)
    plain = torch.nn.functional.conv2d(x, layer.weight, padding=1)
    torch.testing.assert_close(layer(x), 0.5 * plain + layer.bias[None, :, None, None])


@pytest.mark.parametrize("size_hw", [(1, 1), (1, 7), (6, 5)])
def test_layer_equals_place_by_place(size_hw: tuple[int, int]) -> None:
    layer, x = restless_layer(), torch.randn(1, 4, *size_hw, generator=torch.Generator().manual_seed(1))
    predicted = layer.conv_offset(x).detach()
    assert predicted[:, :18].abs().max() > 2
    expected = by_hand(x.double().numpy(), layer, predicted.double().numpy())
    np.testing.assert_allclose(layer(x).detach().numpy(), expected, atol=GATHER_ROUNDING)


def test_gradients_are_those_of_differences() -> None:
    layer, x = restless_layer(2, 2).double(), torch.randn(1, 2, 3, 4, dtype=torch.float64, requires_grad=True)
    predicted = layer.conv_offset(x.detach()).detach()
    offset = predicted[:, :18].clone().requires_grad_()
    mask = predicted[:, 18:].sigmoid().requires_grad_()

    def call(x, weight, offset, mask):  # type: ignore[no-untyped-def]
        return deformable_conv2d(x, weight, layer.bias.detach(), offset=offset, mask=mask)

    assert torch.autograd.gradcheck(call, (x, layer.weight, offset, mask))


def test_bfloat16_autocast_keeps_positions() -> None:
    layer, x = restless_layer(), torch.randn(1, 4, 6, 40)
    predicted = layer.conv_offset(x).detach()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        out = deformable_conv2d(x, layer.weight, layer.bias, offset=predicted[:, :18], mask=predicted[:, 18:])
    assert out.dtype == torch.float32
    expected = deformable_conv2d(x, layer.weight, layer.bias, offset=predicted[:, :18], mask=predicted[:, 18:])
    torch.testing.assert_close(out, expected)


def test_layer_is_one_node_and_computes_the_same() -> None:
    pytest.importorskip("onnx")
    from export.to_onnx import to_onnx

    layer, x = restless_layer(), torch.randn(1, 4, 6, 9)
    model = to_onnx(layer, {"x": x}, ("y",), opset_version=ONNX_OPSET)
    assert [node.op_type for node in model.graph.node].count("DeformConv") == 1
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", ONNX_OPSET)]
    with open_session(model.SerializeToString(), name="layer") as session:
        (found,) = session.run({"x": x.numpy()}, outputs=("y",))
    np.testing.assert_allclose(found, layer(x).detach().numpy(), atol=GATHER_ROUNDING)


@pytest.fixture(scope="module")
def official_checkpoint(reference_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A file with the names, shapes and loss buffers of an official checkpoint."""
    make = load_module(reference_dir / "make_state_dict.py").entry
    spec = json.loads((reference_dir / "mono_deform_conv_names.json").read_text())
    state = {
        f"module.{name}": torch.from_numpy(np.asarray(make(name, shape, 0, spec["fixed"])))
        for name, shape in spec["entries"]
    }
    path = tmp_path_factory.mktemp("official") / "Mono3D_latest.pth"
    torch.save(state, path)
    yield path
    path.unlink()


@pytest.fixture(scope="module")
def official_detector(official_checkpoint: Path) -> MonoDetector:
    detector = MonoDetector(preset("mono")).eval()
    load_weights(detector, official_checkpoint)
    return detector


@pytest.fixture(scope="module")
def image(reference_dir: Path) -> NDArray[np.float32]:
    make_inputs = load_module(reference_dir / "make_inputs.py")
    left, _, _ = make_inputs.pair_u8(96, 320, 4000)
    return np.asarray(make_inputs.normalise(left))


def bound(reference_dir: Path, name: str) -> float:
    facts = json.loads((reference_dir / "net_96x320.json").read_text())["tensors"]
    return ROUNDING_FACTOR * float(facts[ROUNDING_LIKE[name]]["max_abs_diff_fp32_vs_fp64"])


def recorded_part(name: str, full: NDArray[np.float32]) -> NDArray[np.float32]:
    """What the recording keeps of a tensor."""
    if name == "cls_out":
        return full
    if name == "reg_out":
        return full[:, ::8]
    return full[:, :: full.shape[1] // 16, ::2, ::2]


@pytest.mark.slow
def test_parameters_are_the_official_ones(reference_dir: Path) -> None:
    with torch.device("meta"):
        detector = MonoDetector(preset("mono"))
    spec = json.loads((reference_dir / "mono_deform_conv_names.json").read_text())
    constants = sum(int(np.prod(shape)) for name, shape in spec["entries"] if name in spec["fixed"])
    expected = json.loads((reference_dir / "mono.json").read_text())["deform_conv"]["params"]
    assert sum(p.numel() for p in detector.parameters()) in (expected, expected - constants)


@pytest.mark.slow
def test_intermediates_equal_the_recording(
    official_detector: MonoDetector, image: NDArray[np.float32], reference_dir: Path
) -> None:
    seen: dict[str, torch.Tensor] = {}

    def keep(name: str):  # type: ignore[no-untyped-def]
        def hook(_module: object, _inputs: object, output: torch.Tensor) -> None:
            seen[name] = output.clone()

        return hook

    hooks = [
        official_detector.backbone.layer1.register_forward_hook(keep("layer1")),
        official_detector.backbone.layer3.register_forward_hook(keep("features_s16")),
        official_detector.head.regression[0].register_forward_hook(keep("deform_conv")),
    ]
    with torch.no_grad():
        seen["cls_out"], seen["reg_out"] = official_detector(torch.from_numpy(image))
    for hook in hooks:
        hook.remove()
    recorded = np.load(reference_dir / "mono.npz")
    facts = json.loads((reference_dir / "mono.json").read_text())["deform_conv"]["tensors"]
    for name, value in seen.items():
        full = value.numpy()
        assert list(full.shape) == facts[name]["shape"], name
        assert full.mean() == pytest.approx(facts[name]["mean"], abs=bound(reference_dir, name)), name
        apart = np.abs(recorded_part(name, full) - recorded[CASE + name]).max()
        assert apart <= bound(reference_dir, name), name


@pytest.mark.slow
def test_onnx_file_equals_the_recording(
    official_detector: MonoDetector, image: NDArray[np.float32], reference_dir: Path
) -> None:
    pytest.importorskip("onnx")
    import onnxruntime

    from export.to_onnx import to_onnx

    model = to_onnx(
        official_detector,
        {"left": torch.from_numpy(image)},
        ("cls_logits", "box_deltas"),
        opset_version=preset("mono").onnx_opset,
    )
    session = onnxruntime.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    outputs = dict(zip(("cls_out", "reg_out"), session.run(None, {"left": image}), strict=True))
    recorded = np.load(reference_dir / "mono.npz")
    for name, full in outputs.items():
        apart = np.abs(recorded_part(name, full) - recorded[CASE + name]).max()
        assert apart <= bound(reference_dir, name), name
