"""``edge export`` as a user runs it, with a small preset of the same family."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import numpy as np
import pytest
import typer

from runtime.contracts.confidence import ConfidenceRecord, write_confidence
from runtime.contracts.manifest import AnchorPriors, open_model_directory, write_priors
from runtime.refinement import FEATURES
from runtime.session import open_session

torch = pytest.importorskip("torch")
onnx = pytest.importorskip("onnx")
cv2 = pytest.importorskip("cv2")
import export.to_onnx  # noqa: E402
from edge.cli.main import app  # noqa: E402
from edge.detector.ablations import ablated  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import PRESETS, Preset  # noqa: E402
from edge.detector.weights import save_weights  # noqa: E402

pytestmark = pytest.mark.torch

IMAGE_WH = (620, 188)


@pytest.fixture(scope="module")
def small() -> Preset:
    """The compact preset at a sixth of the width and a small image."""
    compact = PRESETS["compact"]
    network = dataclasses.replace(compact.network, backbone_widths=(8, 16, 32))
    return dataclasses.replace(compact, name="small", input_size_hw=(64, 192), network=network)


@pytest.fixture(autouse=True)
def _known_preset(small: Preset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PRESETS, "small", small)


@pytest.fixture(scope="module")
def run_folder(small: Preset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a training run leaves: weights and priors."""
    folder = tmp_path_factory.mktemp("run")
    torch.manual_seed(0)
    detector = StereoDetector(small)
    for weight in detector.head.parameters():  # the last layers start at zero
        if weight.dim() > 1:
            torch.nn.init.normal_(weight, 0, 0.05)
    save_weights(folder / "weights.safetensors", detector.state_dict(), metadata={})
    write_priors(folder / "priors.npz", small.classes, some_priors(small))
    return folder


def some_priors(preset: Preset) -> AnchorPriors:
    shape = (len(preset.classes), preset.anchors.scale_count, len(preset.anchors.ratios), 6)
    return AnchorPriors(np.full(shape, 20, np.float32), np.ones(shape, np.float32))


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Two noisy pairs in KITTI object layout."""
    root = tmp_path_factory.mktemp("kitti") / "training"
    rng = np.random.default_rng(0)
    for folder in ("image_2", "image_3", "calib"):
        (root / folder).mkdir(parents=True)
    for frame in ("000000", "000001"):
        for folder in ("image_2", "image_3"):
            image = rng.integers(0, 256, (IMAGE_WH[1], IMAGE_WH[0], 3), dtype=np.uint8)
            assert cv2.imwrite(str(root / folder / f"{frame}.png"), image)
        rows = [f"P{index}: 360 0 310 {-190.0 * (index == 3)} 0 360 90 0 0 0 1 0" for index in range(4)]
        rows.append("R0_rect: 1 0 0 0 1 0 0 0 1")
        (root / "calib" / f"{frame}.txt").write_text("\n".join(rows) + "\n")
    return f"kitti-object:{root.parent}"


def run_edge(*arguments: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        typer.main.get_command(app).main([str(argument) for argument in arguments])
    return int(ended.value.code or 0)


def export_small(run_folder: Path, out: Path, source: str, *more: str | Path) -> int:
    weights = run_folder / "weights.safetensors"
    return run_edge(*("export", "--preset", "small", "--checkpoint", weights, "--out", out, "--source", source), *more)


@pytest.fixture(scope="module")
def exported(small: Preset, run_folder: Path, source: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The model directory of one run with default options."""
    out = tmp_path_factory.mktemp("models") / "model"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "small", small)
        assert export_small(run_folder, out, source) == 0
    return out


def test_writes_a_model_that_runs(exported: Path, run_folder: Path) -> None:
    directory = open_model_directory(exported)
    assert (directory.manifest.preset, directory.manifest.input_type) == ("small", "uint8")
    assert "on 2 frames" in directory.manifest.provenance["parity"]
    with open_session(directory.model_path) as session:
        assert [(item.name, item.shape, item.dtype) for item in session.inputs] == [
            ("left", (1, 3, 64, 192), np.uint8),
            ("right", (1, 3, 64, 192), np.uint8),
        ]
        anchors = 4 * 12 * directory.manifest.anchors.per_cell
        assert [item.shape for item in session.outputs] == [(1, anchors, 4), (1, anchors, 12)]
    assert str(run_folder).encode() not in directory.model_path.read_bytes()


def test_confidence_beside_the_weights_or_given(
    exported: Path,
    run_folder: Path,
    source: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(export.to_onnx, "to_onnx", lambda *_, **__: onnx.load(exported / "model.onnx"))
    folder = Path(shutil.copytree(run_folder, tmp_path / "run"))
    weights = {"Car": tuple(0.1 * number for number in range(len(FEATURES) + 1))}
    write_confidence(folder / "weights-confidence.json", ConfidenceRecord(weights, {"frames": "9"}))
    assert open_model_directory(exported).manifest.confidence == {}
    assert export_small(folder, tmp_path / "beside", source) == 0
    assert "confidence: " in capsys.readouterr().err
    manifest = open_model_directory(tmp_path / "beside").manifest
    assert manifest.confidence == weights and manifest.provenance["confidence_frames"] == "9"
    write_confidence(tmp_path / "other.json", ConfidenceRecord(weights, {"checkpoint_sha256": "of another run"}))
    assert export_small(folder, tmp_path / "other", source, "--confidence", tmp_path / "other.json") == 0
    assert "learned from boxes of other weights" in capsys.readouterr().err
    write_confidence(tmp_path / "given.json", ConfidenceRecord({"Car": (0.0,) * 3}))
    assert export_small(folder, tmp_path / "given", source, "--confidence", tmp_path / "given.json") == 2
    assert "has 3 numbers for Car" in capsys.readouterr().err
    assert not (tmp_path / "given").exists()


def test_vote_is_the_models_or_the_presets(
    exported: Path, run_folder: Path, source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(export.to_onnx, "to_onnx", lambda *_, **__: onnx.load(exported / "model.onnx"))
    before = open_model_directory(exported).manifest
    assert export_small(run_folder, tmp_path / "voting", source, "--vote", "0.6") == 0
    after = open_model_directory(tmp_path / "voting").manifest
    assert before.nms.voting_iou != 0.6 and after.nms == dataclasses.replace(before.nms, voting_iou=0.6)
    assert export_small(run_folder, tmp_path / "beyond", source, "--vote", "1.5") == 2
    assert not (tmp_path / "beyond").exists()


@pytest.mark.slow
def test_float_input(run_folder: Path, source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "model"
    assert export_small(run_folder, out, source, "--input", "float32", "--frames", "1") == 0
    assert "cls_logits: max|a-b|/max|a|" in capsys.readouterr().err
    with open_session(open_model_directory(out).model_path) as session:
        assert {item.dtype for item in session.inputs} == {np.dtype(np.float32)}


def test_missed_parity_is_exit_1_with_the_numbers_and_writes_nothing(
    exported: Path,
    run_folder: Path,
    source: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A graph with one weight a little off, as a faulty exporter would leave it."""
    faulty = onnx.load(exported / "model.onnx")
    weight = next(item for item in faulty.graph.initializer if item.name == "backbone.conv1.weight")
    values = onnx.numpy_helper.to_array(weight).copy()
    values[0] *= 1.1
    weight.CopyFrom(onnx.numpy_helper.from_array(values, weight.name))
    monkeypatch.setattr(export.to_onnx, "to_onnx", lambda *_, **__: faulty)
    assert export_small(run_folder, tmp_path / "model", source) == 1
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert last.startswith("error: parity: found cls_logits: max|a-b|/max|a|") and "at most 0.0001" in last
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"--checkpoint": "none.safetensors"}, "none.safetensors is not there"),
        ({"--preset": "compact"}, "choose its --preset"),
        ({"--preset": "huge"}, "preset is 'huge'"),
        ({"--priors": "."}, "found no anchor priors"),
        ({"--source": "kitti-object:nowhere"}, "nowhere"),
    ],
)
def test_wrong_input_is_one_line_and_exit_2(
    run_folder: Path,
    source: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    change: dict[str, str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    options = {
        "--preset": "small",
        "--checkpoint": str(run_folder / "weights.safetensors"),
        "--out": "model",
        "--source": source,
    }
    assert run_edge("export", *(word for pair in (options | change).items() for word in pair)) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and said in lines[0]
    assert not list(tmp_path.iterdir())


def test_a_taken_place_is_said_before_the_export(
    run_folder: Path,
    source: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    monkeypatch.setattr(
        export.to_onnx, "to_onnx", lambda *_, **__: pytest.fail("exported before the place was looked at")
    )
    assert export_small(run_folder, tmp_path, source) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1 and "choose another --out" in lines[0]
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


@pytest.mark.slow
def test_ablated_weights_need_their_ablations(
    small: Preset, source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = ("naive-channel-expansion", "no-scale-8", "no-scale-16", "no-anchor-prior")
    chosen = ablated(small, names)
    folder = tmp_path / "run"
    folder.mkdir()
    save_weights(folder / "weights.safetensors", StereoDetector(chosen).state_dict(), metadata={"preset": chosen.name})
    write_priors(folder / "priors.npz", small.classes, some_priors(small))
    assert export_small(folder, tmp_path / "model", source) == 2
    assert capsys.readouterr().err.count("\n") == 1
    flags = [part for name in names for part in ("--ablate", name)]
    assert export_small(folder, tmp_path / "model", source, "--frames", "1", *flags) == 0
    manifest = open_model_directory(tmp_path / "model").manifest
    assert manifest.preset == chosen.name and not manifest.anchors.depth_by_prior
