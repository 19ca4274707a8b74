"""``edge export`` of official checkpoints, as a user with a ``.pth`` and a folder of prior tables runs it."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer

from runtime.contracts.manifest import PRIOR_QUANTITIES, open_model_directory
from runtime.decode import Decoder

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")
pytest.importorskip("onnx")
import onnxruntime  # noqa: E402 - plain, without the native library

from edge.cli.main import app  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.official import from_official, official_name  # noqa: E402
from edge.detector.official_shapes import expected_shapes  # noqa: E402
from edge.detector.presets import HeadShape, NeckShape, NetworkShape, Preset, preset  # noqa: E402

pytestmark = pytest.mark.torch

GOLDEN = Path(__file__).resolve().parents[2] / "golden"
ROUNDING_FACTOR = 10.0  # the recordings' own float32-to-float64 difference, times this
OF_THE_LARGEST = 2e-4  # max|a - b| / max|a| of an output
PIXEL_TOLERANCE, METRIC_TOLERANCE, SCORE_TOLERANCE = 1e-2, 1e-3, 1e-4  # of boxes of two float32 networks
PAPER = preset("paper")
NARROW = NetworkShape(
    backbone_depth=18,
    backbone_widths=(4, 6, 8),
    neck=NeckShape(6, 5, 4, 3, 10, 14, 18, (9, 7), 16),
    head=HeadShape(class_width=11, box_width=13),
)


def run_edge(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        typer.main.get_command(app).main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def by_rule() -> ModuleType:
    spec = importlib.util.spec_from_file_location("recorded_case", GOLDEN / "network" / "recorded_case.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def official_state(chosen: Preset) -> dict[str, torch.Tensor]:
    """Weights by the recordings' rule, under the official names and as a parallel model saves them."""
    rule = by_rule()
    shapes = {official_name(name): shape for name, shape in expected_shapes(chosen).items()}
    state = {name: torch.from_numpy(np.asarray(value)) for name, value in rule.state_dict(shapes).items()}
    constants = {name: torch.tensor(values) for name, values in rule.LOSS_CONSTANTS.items()}
    return {f"module.{name}": value for name, value in (state | constants).items()}


def write_tables(folder: Path, classes: tuple[str, ...]) -> Path:
    """The official code's tables of some classes, from the recorded priors."""
    folder.mkdir(parents=True)
    with np.load(GOLDEN / "official" / "priors.npz") as tables:
        for name in classes:
            for part in ("mean", "std"):
                np.save(folder / f"anchor_{part}_{name}.npy", tables[f"{name}_{part}"].astype(np.float64))
    return folder


@pytest.fixture(scope="module")
def narrow(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a checkpoint of one class, narrow and of another depth than the preset, and its tables."""
    folder = tmp_path_factory.mktemp("official")
    chosen = dataclasses.replace(PAPER, classes=("Car",), network=NARROW)
    torch.save(official_state(chosen), folder / "Stereo3D_latest.pth")
    write_tables(folder / "prepared" / "training", ("Car",))
    return folder


def export_official(folder: Path, out: Path, *more: str | Path) -> int:
    checkpoint = folder / "Stereo3D_latest.pth"
    command = ("export", "--preset", "paper", "--checkpoint", checkpoint, "--priors", folder / "prepared", "--out", out)
    return run_edge(*command, "--input", "float32", "--frames", "1", *more)


def run_plain(model: Path, feeds: dict[str, Any]) -> list[Any]:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(str(model), options, providers=["CPUExecutionProvider"])
    return list(session.run(["cls_logits", "box_deltas"], feeds))


def test_other_widths_depth_and_classes(narrow: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export_official(narrow, tmp_path / "model") == 0
    assert "classes by the files of the priors: Car" in capsys.readouterr().err
    directory = open_model_directory(tmp_path / "model")
    assert (directory.manifest.preset, directory.manifest.classes) == ("paper", ("Car",))
    assert directory.priors.mean.shape == (1, 16, 3, len(PRIOR_QUANTITIES))

    detector = StereoDetector(dataclasses.replace(PAPER, classes=("Car",), network=NARROW)).eval()
    saved = torch.load(narrow / "Stereo3D_latest.pth", weights_only=True)
    detector.load_state_dict(from_official({name.removeprefix("module."): value for name, value in saved.items()}))
    rule = by_rule()
    views = [rule.normalised(image) for image in rule.image_pair(288, 1280, 1001)]
    found = run_plain(directory.model_path, dict(zip(("left", "right"), views, strict=True)))
    with torch.no_grad():
        expected = [output.numpy() for output in detector(*map(torch.from_numpy, views))]
    for value, wanted in zip(found, expected, strict=True):
        assert np.abs(value - wanted).max() <= OF_THE_LARGEST * np.abs(wanted).max()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"core.backbone.layer1.0.conv2.weight": None}, "lacks core.backbone.layer1.0.conv2.weight 4x4x3x3;"),
        ({"core.backbone.bn1.bias": (9,)}, "has core.backbone.bn1.bias 9 instead of 4;"),
        ({"core.attention.weight": (2, 2)}, "has the unknown core.attention.weight 2x2;"),
        ({"bbox_head.cls_feature_extraction.6.bias": (7,)}, "bbox_head.cls_feature_extraction.6.bias 7 instead of 96;"),
    ],
)
def test_a_wrong_checkpoint_is_one_line_and_exit_2(
    narrow: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, tuple[int, ...] | None],
    said: str,
) -> None:
    state = torch.load(narrow / "Stereo3D_latest.pth", weights_only=True)
    for name, shape in change.items():
        state.pop(f"module.{name}", None)
        if shape is not None:
            state[f"module.{name}"] = torch.zeros(shape)
    torch.save(state, tmp_path / "wrong.pth")
    out = tmp_path / "model"
    arguments = ("--classes", "Car", "--checkpoint", tmp_path / "wrong.pth")
    assert export_official(narrow, out, *arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0] and "wrong.pth" in lines[0]
    assert not out.exists()


def test_two_classes_of_tables_do_not_name_one_class(
    narrow: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tables = write_tables(tmp_path / "tables", PAPER.classes)
    assert export_official(narrow, tmp_path / "model", "--priors", tables) == 2
    assert "1 classes" in (line := capsys.readouterr().err) and "--classes" in line


@pytest.fixture(scope="module")
def paper_model(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The recorded case as a model directory; its 800 MB do not stay."""
    folder = tmp_path_factory.mktemp("recorded")
    torch.save({"epoch": 79, "model_state_dict": official_state(PAPER)}, folder / "Stereo3D_latest.pth")
    write_tables(folder / "prepared", PAPER.classes)
    assert export_official(folder, folder / "model") == 0
    (folder / "Stereo3D_latest.pth").unlink()
    yield folder / "model"
    (folder / "model" / "model.onnx").unlink()


@pytest.mark.slow
def test_the_exported_paper_network_equals_the_recording(paper_model: Path) -> None:
    facts = json.loads((GOLDEN / "network" / "net_288x1280.json").read_text())
    with np.load(GOLDEN / "network" / "net_288x1280.npz") as file:
        recorded = dict(file)
    rule = by_rule()
    views = [rule.normalised(image) for image in rule.image_pair(288, 1280, 1000)]
    directory = open_model_directory(paper_model)
    outputs = run_plain(directory.model_path, dict(zip(("left", "right"), views, strict=True)))
    for name, value in zip(("cls_out", "reg_out"), outputs, strict=True):
        entry, expected = facts["tensors"][name], recorded[name]
        apart = np.abs(value.ravel()[:: entry["step"]] - expected).max()
        assert apart <= ROUNDING_FACTOR * entry["rounding"] and apart <= OF_THE_LARGEST * entry["largest"], name

    decoder = Decoder(directory.manifest, directory.priors)
    found = decoder.decode_in_network(*outputs, P2=np.array(facts["P2"]), score=0.75)
    np.testing.assert_array_equal(found.anchor_index, recorded["det_anchor_index"])
    np.testing.assert_array_equal(found.class_id, recorded["det_label_aligned"])
    np.testing.assert_allclose(found.score, recorded["det_scores"], rtol=0, atol=SCORE_TOLERANCE)
    np.testing.assert_allclose(found.boxes[:, :6], recorded["det_boxes"][:, :6], rtol=0, atol=PIXEL_TOLERANCE)
    np.testing.assert_allclose(found.boxes[:, 6:], recorded["det_boxes"][:, 6:], rtol=0, atol=METRIC_TOLERANCE)
