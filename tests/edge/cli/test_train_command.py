"""``edge train`` as a user runs it: a new run, a longer one from its checkpoint, validation, and what is refused."""

from __future__ import annotations

import csv
import dataclasses
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import typer

from runtime.contracts.errors import OutputError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_calib
from runtime.contracts.manifest import AnchorPriors, file_sha256, write_priors

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.cli.main import app  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import PRESETS, HeadShape, NeckShape, NetworkShape, Preset  # noqa: E402
from edge.detector.weights import load_weights  # noqa: E402
from edge.training.start import open_run  # noqa: E402

pytestmark = pytest.mark.torch

SIZE_WH = (620, 188)
CAR = "Car 0.00 0 -1.58 {x} 75 {x2} 101 1.65 1.67 3.64 -0.65 1.71 26.70 -1.59\n"
P2 = np.array([[360.7, 0, 304.8, 22.4], [0, 360.7, 86.4, 0.1], [0, 0, 1, 0.0027]])
P3 = np.array([[360.7, 0, 304.8, -169.8], [0, 360.7, 86.4, 1.1], [0, 0, 1, 0.0027]])


@pytest.fixture(autouse=True)
def tiny(monkeypatch: pytest.MonkeyPatch) -> Preset:
    """The compact preset 16 channels wide on a small image, known by the name ``tiny``."""
    compact = PRESETS["compact"]
    network = NetworkShape(
        18, (16, 16, 16), NeckShape(16, 8, 8, 4, 16, 16, 16, (16, 16), 96), HeadShape(16, 16, 1, 1, 0.1, 0.01)
    )
    rig = dataclasses.replace(compact.rig, focal_px=260.0)
    chosen = dataclasses.replace(compact, name="tiny", input_size_hw=(96, 448), rig=rig, network=network)
    monkeypatch.setitem(PRESETS, "tiny", chosen)
    return chosen


@pytest.fixture(autouse=True)
def _one_thread():  # type: ignore[no-untyped-def]
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def drive(tmp_path: Path) -> str:
    """Four labelled pairs."""
    root = tmp_path / "drive"
    for folder in ("image_2", "image_3", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    generator = np.random.default_rng(0)
    for index in range(4):
        for folder in ("image_2", "image_3"):
            pixels = generator.integers(60, 90, (SIZE_WH[1], SIZE_WH[0], 3)).astype(np.uint8)
            assert cv2.imwrite(str(root / "training" / folder / f"{index:06d}.png"), pixels)
        (root / "training/calib" / f"{index:06d}.txt").write_text(format_calib(StereoGeometry(P2, P3, SIZE_WH)))
        labels = CAR.format(x=200 + 50 * index, x2=230 + 50 * index) if index else ""  # one frame has no object
        (root / "training/label_2" / f"{index:06d}.txt").write_text(labels)
    return f"kitti-object:{root}"


@pytest.fixture
def priors(tiny: Preset, tmp_path: Path) -> Path:
    """Tables of cars about 25 m away; four frames have too few to compute them."""
    shape = (len(tiny.classes), tiny.anchors.scale_count, len(tiny.anchors.ratios), 6)
    mean = np.broadcast_to(np.array([25, 0, -0.5, 1.6, 1.5, 3.9], np.float32), shape)
    std = np.broadcast_to(np.array([8, 0.7, 0.7, 0.2, 0.2, 0.5], np.float32), shape)
    write_priors(tmp_path / "given.npz", tiny.classes, AnchorPriors(mean.copy(), std.copy()))
    return tmp_path / "given.npz"


def edge(*arguments: object) -> int:
    """Exit code of a command."""
    with pytest.raises(SystemExit) as ended:
        typer.main.get_command(app)([str(argument) for argument in arguments])
    code = ended.value.code
    assert isinstance(code, int)
    return code


def train(drive: str, out: Path, *more: object) -> int:
    return edge(
        "train", "--preset", "tiny", "--dataset", drive, "--out", out, "--batch", 2, "--workers", 0, "--precision",
        "float32", *more,
    )  # fmt: skip


def test_a_run_and_a_longer_one_from_its_checkpoint(drive: str, tiny: Preset, priors: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    assert train(drive, out, "--epochs", 1, "--validation", drive, "--priors", priors) == 0
    files = {path.name for path in out.iterdir()}
    assert files >= {
        "best.safetensors", "checkpoint.pt", "log.csv", "log.png", "priors.npz", "run.json", "validation.jsonl",
        "weights.safetensors",
    }  # fmt: skip
    assert train(drive, out, "--epochs", 2, "--validation", drive, "--resume") == 0
    lines = [json.loads(line) for line in (out / "validation.jsonl").read_text().splitlines()]
    assert [line["step"] for line in lines] == [2, 4]  # after each epoch of two steps
    assert lines[0]["frames"] == 4 and lines[0]["objects"]["Car"][2] == 3
    with (out / "log.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert all(float(row["box_loss"]) > 0 for row in rows)
    assert [row["step"] for row in rows] == ["2", "4"]  # a run's last step closes its line
    stages = json.loads((out / "run.json").read_text())["stages"]
    assert [(stage["from_step"], stage["settings"]["steps"]) for stage in stages] == [(0, 2), (2, 4)]
    load_weights(StereoDetector(tiny), out / "weights.safetensors")


def test_average_of_decay_zero_saves_the_last_weights(drive: str, tiny: Preset, priors: Path, tmp_path: Path) -> None:
    out = tmp_path / "run"
    options = ("--average-decay", 0, "--schedule", "cosine", "--method", "official", "--priors", priors)
    assert train(drive, out, "--steps", 2, *options) == 0
    saved = StereoDetector(tiny)
    load_weights(saved, out / "weights.safetensors")
    last = torch.load(out / "checkpoint.pt", weights_only=True)["model"]
    for name, value in saved.state_dict().items():
        if value.dtype.is_floating_point:
            assert torch.equal(value, last[name].half().float()), name


@pytest.mark.parametrize(
    ("more", "word"),
    [
        (["--steps", "2", "--epochs", "2"], "leave one out"),
        (["--schedule", "linear"], "expected hold, cosine"),
        (["--method", "mine"], "expected one of paper, official"),
        (["--device", "tpu"], "expected cpu or cuda"),
        (["--repeat", "1", "--repeat", "2"], "expected at most one each"),
        (["--resume"], "without --resume"),
        (["--learning-rate", "0"], "expected more than 0"),
        (["--seed", "-1"], "--seed"),
        (["--workers", "-1"], "--workers"),
        (["--cooldown", "-1"], "--cooldown"),
        (["--before-cooldown"], "expected --resume beside it"),
        (["--ablate", "no-disparity-supervision", "--unlabelled", "frames:any"], "learns no disparity"),
    ],
)
def test_wrong_input_is_one_line(
    drive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], word: str
) -> None:
    assert train(drive, tmp_path / "run", *more) == 2
    error = capsys.readouterr().err.strip()
    assert word in error
    assert error.count("\n") == 0


def test_frames_too_few_for_priors_end_without_failure(drive: str, tmp_path: Path) -> None:
    assert train(drive, tmp_path / "run", "--steps", 2) == 0


def test_a_folder_that_holds_something_is_left_alone(
    drive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "kept").write_text("mine")
    assert train(drive, tmp_path, "--steps", 1) == 2
    assert "is not empty" in capsys.readouterr().err
    assert (tmp_path / "kept").read_text() == "mine" and not (tmp_path / "checkpoint.pt").exists()


def test_the_corrected_command_starts_where_a_start_failed(
    drive: str, tiny: Preset, priors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, bare, malformed = tmp_path / "run", tmp_path / "bare", tmp_path / "malformed.npz"
    shutil.copytree(tmp_path / "drive", bare)
    shutil.rmtree(bare / "training" / "label_2")
    malformed.write_bytes(priors.read_bytes()[:100])
    shape = (len(tiny.classes), tiny.anchors.scale_count, len(tiny.anchors.ratios), 6)
    write_priors(tmp_path / "other.npz", tiny.classes, AnchorPriors(np.ones(shape, "f4"), np.ones(shape, "f4")))
    given = ["--priors", tmp_path / "other.npz"]
    for wrong, word in (
        (["--priors", malformed], "malformed.npz"),
        ([*given, "--backbone", tmp_path / "none.pth"], "none.pth"),
        ([*given, "--start", tmp_path / "none.pt"], "none.pt"),
        ([*given, "--steps", 1, "--epochs", 1], "leave one out"),
        ([*given, "--steps", 1, "--validation", f"kitti-object:{bare}"], "no labelled frame"),
    ):
        assert train(drive, out, *wrong) == 2
        assert word in capsys.readouterr().err
        assert {path.name for path in out.iterdir()} <= {"priors.npz.part"}
    assert train(f"kitti-object:{bare}", out, *given, "--steps", 1) == 2
    assert "hold no labelled frame" in capsys.readouterr().err
    assert train(drive, out, "--priors", priors, "--steps", 1) == 0
    assert (out / "priors.npz").read_bytes() == priors.read_bytes()
    assert not (out / "priors.npz.part").exists()


def test_what_may_be_begun_anew_and_what_may_not(tmp_path: Path) -> None:
    for names, free in (
        ((), True),
        (("priors.npz.part",), True),
        (("priors.npz", "run.json"), True),  # stopped before the first step
        (("priors.npz",), False),  # of `edge priors`, perhaps
        (("priors.npz", "run.json", "card.md"), True),
        (("priors.npz", "run.json", "log.csv"), False),
        (("card.md",), False),
        (("run.json", "mine"), False),
    ):
        out = tmp_path / "-".join(("run", *names))
        out.mkdir()
        for name in names:
            (out / name).write_text("x")
        if free:
            assert open_run(out, resume=False) == 0
        else:
            with pytest.raises(OutputError, match=r"choose another --out$"):  # --resume would not help
                open_run(out, resume=False)
        assert {path.name for path in out.iterdir()} == (set() if free else set(names))
    (tmp_path / "checkpoint.pt").touch()
    with pytest.raises(OutputError, match="add --resume"):
        open_run(tmp_path, resume=False)
    with pytest.raises(OutputError, match="cannot be made"):
        open_run(tmp_path / "checkpoint.pt" / "run", resume=False)


def test_a_resumed_run_keeps_its_length_and_goes_back_before_its_cooldown(
    drive: str, priors: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    assert train(drive, out, "--steps", 3, "--cooldown", 2, "--priors", priors) == 0
    assert f"priors: {priors}" in capsys.readouterr().err
    assert train(drive, out, "--resume", "--steps", 2) == 2
    assert "has done 3" in capsys.readouterr().err
    assert train(drive, out, "--resume", "--freeze-backbone", 4) == 2
    assert "training.frozen_backbone_parts" in capsys.readouterr().err
    capsys.readouterr()
    assert train(drive, out, "--resume", "--before-cooldown", "--batch", 1) == 2
    assert not (out / "checkpoint-3.pt").exists(), "a refused command leaves the run as it was"
    assert torch.load(out / "checkpoint.pt", weights_only=True)["step"] == 3
    assert train(drive, out, "--resume", "--before-cooldown", "--cooldown", 2) == 0
    assert torch.load(out / "checkpoint-3.pt", weights_only=True)["step"] == 3
    assert torch.load(out / "checkpoint.pt", weights_only=True)["step"] == 3
    stages = json.loads((out / "run.json").read_text())["stages"]
    assert [(stage["from_step"], stage["settings"]["steps"]) for stage in stages] == [(0, 3), (1, 3)]
    assert [row.split(",")[0] for row in (out / "log.csv").read_text().splitlines()[1:]] == ["3"]
    (out / "best.safetensors").write_bytes(b"the best of four steps")
    assert train(drive, out, "--resume", "--before-cooldown", "--steps", 4, "--cooldown", 0) == 0
    assert train(drive, out, "--resume", "--before-cooldown", "--steps", 2, "--cooldown", 0) == 0
    assert {path.name for path in out.glob("checkpoint-?.pt")} == {"checkpoint-3.pt", "checkpoint-4.pt"}
    assert (out / "best-4.safetensors").read_bytes() == b"the best of four steps"
    bare = tmp_path / "bare"
    assert train(drive, bare, "--steps", 1, "--cooldown", 0, "--priors", priors) == 0
    assert train(drive, bare, "--resume", "--before-cooldown") == 2
    assert "checkpoint-hold.pt is not there" in capsys.readouterr().err


def test_the_licence_of_the_start_goes_on_to_the_model(drive: str, tiny: Preset, priors: Path, tmp_path: Path) -> None:
    first, second, model = tmp_path / "first", tmp_path / "second", tmp_path / "model"
    assert train(drive, first, "--steps", 1, "--priors", priors) == 0
    (first / "card.md").write_text("Licence: of the start.\n")
    start = first / "weights.safetensors"
    assert train(drive, second, "--steps", 1, "--start", start, "--priors", first / "priors.npz") == 0
    card = (second / "card.md").read_text()
    assert "from `weights.safetensors` and `priors.npz`." in card and card.count("Licence: of the start.") == 1
    (second / "card.md").write_text(card + "What I added.\n")
    assert train(drive, second, "--steps", 2, "--start", start, "--resume") == 0
    assert "What I added." in (second / "card.md").read_text()
    export = ("export", "--preset", tiny.name, "--checkpoint", second / "weights.safetensors", "--out", model)
    assert edge(*export, "--source", f"{drive}?limit=1", "--frames", 1) == 0
    assert "Licence: of the start." in (model / "card.md").read_text()


def test_a_run_says_what_it_starts_from(
    drive: str,
    tiny: Preset,
    priors: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    assert train(drive, first, "--steps", 1, "--priors", priors) == 0
    shape = (len(tiny.classes), tiny.anchors.scale_count, len(tiny.anchors.ratios), 6)
    write_priors(tmp_path / "other.npz", tiny.classes, AnchorPriors(np.ones(shape, "f4"), np.ones(shape, "f4")))
    start, validation = first / "weights.safetensors", f"{drive}?limit=3"
    given = ("--start", start, "--steps", 1, "--validation", validation)
    head = dataclasses.replace(tiny.network.head, box_final_kernel=3)
    wider = dataclasses.replace(tiny, network=dataclasses.replace(tiny.network, head=head))
    monkeypatch.setitem(PRESETS, "tiny", wider)
    capsys.readouterr()
    assert train(drive, second, *given, "--priors", tmp_path / "other.npz", "--ablate", "no-disparity-supervision") == 0
    told = capsys.readouterr().err
    assert "was trained with other priors" in told and "the same ablations" in told
    assert "smaller kernels in head.regression.3.weight:" in told
    assert "3 of 3 validation frames train, too" in told
    assert not (second / "card.md").exists()  # nothing that it began with has one
    origin = json.loads((second / "run.json").read_text())["stages"][0]["origin"]
    assert origin == {
        "method": "preset",
        "priors": str(tmp_path / "other.npz"),
        "start": str(start),
        "start_sha256": file_sha256(start),
        "validation": validation,
    }
