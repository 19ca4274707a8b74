"""The monocular preset from training to stream, a few channels wide, on the left pictures of a small drive."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")
onnx = pytest.importorskip("onnx")
cv2 = pytest.importorskip("cv2")
from typer.main import get_command  # noqa: E402

from edge.cli.main import app  # noqa: E402
from edge.detector.build import build_detector  # noqa: E402
from edge.detector.mono_network import MonoDetector  # noqa: E402
from edge.detector.presets import PRESETS, Preset  # noqa: E402
from edge.detector.weights import load_weights, save_weights  # noqa: E402
from runtime.contracts.manifest import AnchorPriors, Crop, RigLimits, open_model_directory, write_priors  # noqa: E402

pytestmark = pytest.mark.torch

SIZE_HW = (32, 64)


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        get_command(app).main([str(item) for item in arguments])
    return int(ended.value.code or 0)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Preset:
    """Preset mono with 18 layers a few channels wide, for a picture of 32 x 64."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mono = PRESETS["mono"]
    head = dataclasses.replace(mono.network.head, class_width=8, box_width=8)
    network = dataclasses.replace(mono.network, backbone_depth=18, backbone_widths=(8, 8, 8), head=head)
    small = dataclasses.replace(
        mono, name="tiny-mono", input_size_hw=SIZE_HW, crop=Crop("top_rows", 0), rig=RigLimits(100.0, 0.5),
        network=network, thresholds=dataclasses.replace(mono.thresholds, evaluate=0.3, display=0.5),
    )  # fmt: skip
    monkeypatch.setitem(PRESETS, small.name, small)
    return small


@pytest.fixture
def left_pictures(tiny_drive: Path) -> str:
    """The drive's left views, noisy; nothing is left of the right ones."""
    random = np.random.default_rng(5)
    for path in sorted((tiny_drive / "training" / "image_2").iterdir()):
        coarse = random.integers(0, 256, (8, 16, 3)).astype(np.uint8)
        assert cv2.imwrite(str(path), cv2.resize(coarse, (128, 64), interpolation=cv2.INTER_CUBIC))
    for path in (tiny_drive / "training" / "image_3").iterdir():
        path.unlink()
    return f"kitti-object:{tiny_drive}?views=left"


def plain_priors(preset: Preset) -> AnchorPriors:
    shape = (len(preset.classes), preset.anchors.scale_count, len(preset.anchors.ratios), 6)
    mean = np.broadcast_to(np.array([20, 0, 0.5, 1.6, 1.5, 3.9], np.float32), shape).copy()
    return AnchorPriors(mean, np.broadcast_to(np.array([5, 0.7, 0.7, 0.2, 0.2, 0.5], np.float32), shape).copy())


@pytest.fixture
def weights(tiny: Preset, tmp_path: Path) -> Path:
    """Weights that find something: class logits near zero, offsets of a cell or so."""
    folder = tmp_path / "run"
    folder.mkdir()
    torch.manual_seed(0)
    detector = build_detector(tiny)
    assert isinstance(detector, MonoDetector)
    for name, value in detector.head.named_parameters():
        if value.dim() > 1:
            torch.nn.init.normal_(value, 0, 0.15)
        elif name.endswith("conv_offset.bias"):
            torch.nn.init.normal_(value, 0, 0.7)
    save_weights(folder / "weights.safetensors", detector.state_dict(), metadata={})
    write_priors(folder / "priors.npz", tiny.classes, plain_priors(tiny))
    return folder / "weights.safetensors"


def test_export_quantize_stream(tiny: Preset, weights: Path, left_pictures: str, tmp_path: Path) -> None:
    model, small = tmp_path / "model", tmp_path / "model-int8"
    command = ("export", "--preset", tiny.name, "--checkpoint", weights, "--out", model, "--source", left_pictures)
    assert run(*command) == 0
    manifest = open_model_directory(model).manifest
    assert (manifest.views, manifest.hill_climbing, manifest.nms.iou) == (1, True, 0.5)
    graph = onnx.load(model / "model.onnx")
    assert [item.name for item in graph.graph.input] == ["left"]
    assert [node.op_type for node in graph.graph.node].count("DeformConv") == 1

    command = ("quantize", model, "--calibration", left_pictures, "--frames", 2, "--target", "x86-vnni", "--out", small)
    assert run(*command, "--validation", left_pictures, "--allow-overlap") == 0
    quantised = onnx.load(small / "model.onnx")
    deformable = next(node for node in quantised.graph.node if node.op_type == "DeformConv")
    made_by = {name: node for node in quantised.graph.node for name in node.output}
    # DeformConv computes in float; the convolution that predicts its offsets is 8-bit
    before_offsets = [node for node in quantised.graph.node if node.op_type == "Conv" and "conv_offset" in node.name]
    assert len(before_offsets) == 1
    assert made_by[before_offsets[0].input[0]].op_type == "DequantizeLinear"
    assert made_by[before_offsets[0].input[1]].op_type == "DequantizeLinear"
    assert deformable.input[1] not in made_by  # its weights are float initialisers

    for folder in (model, small):
        lines = tmp_path / f"{folder.name}.jsonl"
        assert run("stream", folder, "--source", left_pictures, "--json", lines) == 0
        frames = [json.loads(line) for line in lines.read_text().splitlines()]
        assert [frame["frame_id"] for frame in frames] == ["000000", "000001", "000002", "000003"]


def test_training_takes_left_pictures_alone(tiny: Preset, weights: Path, left_pictures: str, tmp_path: Path) -> None:
    labels = Path(left_pictures.partition(":")[2].partition("?")[0]) / "training" / "label_2"
    for path in labels.iterdir():  # near enough for the smallest anchor: without overlap above one half no box teaches
        path.write_text("Car 0.00 0 -1.65 52 26 108 80 1.50 1.60 3.90 0.64 1.60 8.00 -1.57\n", encoding="utf-8")
    out = tmp_path / "trained"
    command = ("train", "--preset", tiny.name, "--dataset", left_pictures, "--out", out, "--steps", 2, "--batch", 2)
    priors = weights.parent / "priors.npz"
    assert run(*command, "--priors", priors, "--start", weights, "--workers", 0, "--average-decay", 0) == 0
    before, after = build_detector(tiny), build_detector(tiny)
    load_weights(before, weights)
    load_weights(after, out / "weights.safetensors")
    old, new = before.state_dict(), after.state_dict()
    for name in (
        "head.regression.0.conv_offset.weight",
        "head.classification.6.weight",
        "backbone.layer1.0.conv1.weight",
    ):
        assert not torch.equal(old[name], new[name]), name
    assert {name for name in new if name.startswith(("neck.", "disparity_branch."))} == set()
