"""Wrong input of `edge quantize`: one line with the remedy, at once, a missed budget keeps its best."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("onnx")

from edge.cli.main import app
from edge.cli.quantize_input import check_out, check_validation, wanted_budget
from quantize.budget_kinds import Budget
from quantize.errors import QuantizeError
from runtime.contracts.errors import OutputError, SourceError
from runtime.contracts.manifest import open_model_directory
from runtime.model_folder import check_place


@pytest.fixture(autouse=True)
def no_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is wrong must be said before anything is run."""

    def run(*args: object, **options: object) -> None:
        pytest.fail("a model was run before the input was looked at")

    monkeypatch.setattr("calib.ranges.open_session", run)


def complaint(*words: object, code: int = 2) -> str:
    result = CliRunner().invoke(app, ["quantize", *(str(word) for word in words)])
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.exit_code == code, (result.exit_code, result.stderr, result.exception)
    assert len(lines) == 1, result.stderr
    assert result.stderr.splitlines()[-1] == lines[0]
    return lines[0]


def empty(drive: Path) -> None:
    for folder in ("image_2", "image_3"):
        for path in (drive / "training" / folder).iterdir():
            path.unlink()


def one_view(drive: Path) -> None:
    shutil.rmtree(drive / "training" / "image_3")


def views_of_two_sizes(drive: Path) -> None:
    cv2.imwrite(str(drive / "training" / "image_3" / "000001.png"), np.zeros((60, 128, 3), np.uint8))


def wide_baseline(drive: Path) -> None:
    for path in (drive / "training" / "calib").iterdir():
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("-1.000000000000e+02", "-2.000000000000e+02"), encoding="utf-8")


def cut_off(drive: Path) -> None:
    path = drive / "training" / "image_2" / "000001.png"
    path.write_bytes(path.read_bytes()[:-30])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (empty, ("holds no image",)),
        (one_view, ("image_3",)),
        (views_of_two_sizes, ("128x64", "128x60")),
        (wide_baseline, ("baseline", "--allow-other-rig")),
        (cut_off, ("000001", "cut short")),
        (shutil.rmtree, ("tiny-drive",)),
    ],
)
def test_calibration_frames_that_do_not_serve(
    damage: Callable[[Path], object], said: tuple[str, ...], toy_directory: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    damage(tiny_drive)
    line = complaint(toy_directory, "--out", tmp_path / "int8", "--calibration", f"kitti-object:{tiny_drive}")
    for word in said:
        assert word in line
    assert not (tmp_path / "int8").exists()


def cut_model(model: Path) -> None:
    path = model / "model.onnx"
    path.write_bytes(path.read_bytes()[:100])


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda model: (model / "model.onnx").unlink(), "model.onnx"),
        (lambda model: (model / "priors.npz").unlink(), "priors.npz"),
        (lambda model: (model / "manifest.json").unlink(), "manifest.json"),
        (lambda model: (model / "manifest.json").write_text("{"), "no JSON"),
        (cut_model, "sha256"),
        (shutil.rmtree, "tiny-model"),
    ],
)
def test_a_half_broken_model_directory(
    damage: Callable[[Path], object], said: str, toy_directory: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    damage(toy_directory)
    calibration = f"kitti-object:{tiny_drive}"
    assert said in complaint(toy_directory, "--out", tmp_path / "int8", "--calibration", calibration)
    assert not (tmp_path / "int8").exists()


def test_places_that_cannot_be_written(toy_directory: Path, tiny_drive: Path, tmp_path: Path) -> None:
    (tmp_path / "taken.txt").write_text("mine", encoding="utf-8")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine", encoding="utf-8")
    given = [toy_directory, "--calibration", f"kitti-object:{tiny_drive}", "--out"]
    for place, said in (
        (tmp_path / "taken.txt", "no model directory"),
        (tmp_path / "taken.txt" / "int8", "can be written"),
        (tmp_path / "mine", "files of your own"),
        (toy_directory, "own directory"),
        (toy_directory / "int8", "own directory"),
    ):
        line = complaint(*given, place)
        assert said in line
        assert "choose another" in line
    assert (tmp_path / "taken.txt").read_text(encoding="utf-8") == "mine"
    assert open_model_directory(toy_directory).manifest.recipe == "float32"


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (["--max-drop", "1"], "--validation"),
        (["--max-drop", "-1", "--validation", "kitti-object:{drive}"], "0 or more"),
        (["--max-disagreement", "nan", "--validation", "kitti-object:{drive}"], "0 or more"),
        (["--max-drop", "1", "--max-disagreement", "1", "--validation", "kitti-object:{drive}"], "one budget"),
        (["--max-drop", "1", "--max-shift", "1", "--validation", "kitti-object:{drive}"], "one budget"),
        (["--max-shift", "5"], "--max-shift: found no --validation; expected frames to measure on"),
        (["--max-drop", "1", "--validation", "kitti-object:{drive}-gone"], "-gone"),
        (["--validation", "kitti-object:{drive}-gone"], "-gone"),
        (["--validation", "nonsense"], "no scheme"),
        (["--max-drop", "1", "--validation", "kitti-object:{drive}?limit=0"], "limit=0"),
    ],
)
def test_budgets_and_validation_frames(
    extra: list[str], said: str, toy_directory: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    words = [word.format(drive=tiny_drive) for word in extra]
    given = [toy_directory, "--out", tmp_path / "int8", "--calibration", f"kitti-object:{tiny_drive}"]
    assert said in complaint(*given, *words)
    assert not (tmp_path / "int8").exists()


def relabel(drive: Path, name: str | None) -> None:
    for path in (drive / "training" / "label_2").iterdir():
        if name is None:
            path.unlink()
        else:
            path.write_text(path.read_text(encoding="utf-8").replace("Car 0.00 0", name), encoding="utf-8")


@pytest.mark.parametrize("name", [None, "Tram 0.00 0", "Car 0.00 3", "Car 0.99 0"])  # the last two count nowhere
def test_an_ap_budget_without_labels_of_the_classes(
    name: str | None, toy_directory: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    relabel(tiny_drive, name)
    uri = f"kitti-object:{tiny_drive}"
    line = complaint(
        toy_directory, "--out", tmp_path / "int8", "--calibration", uri, "--validation", uri, "--max-drop", 0.5
    )
    assert "no labelled objects" in line
    assert "--max-disagreement" in line
    check_validation(uri, ("Car",), labelled=False)


def test_the_checks_alone(tiny_drive: Path, tmp_path: Path) -> None:
    assert wanted_budget({"--max-drop": None, "--max-shift": None}, None) is None
    assert wanted_budget({"--max-drop": 0.0, "--max-shift": None}, "x:y") == Budget("--max-drop", 0.0)
    assert wanted_budget({"--max-drop": None, "--max-shift": 3.0}, "x:y") == Budget("--max-shift", 3.0)
    with pytest.raises(QuantizeError, match="0 or more"):
        wanted_budget({"--max-drop": -0.5}, "x:y")
    with pytest.raises(SourceError):
        check_validation(f"kitti-object:{tmp_path}/none", ("Car",), labelled=False)
    check_validation(f"kitti-object:{tiny_drive}", ("Car",), labelled=True)
    check_out(tmp_path / "new" / "deeper" / "int8", tmp_path / "model")
    assert not (tmp_path / "new").exists(), "looking makes nothing"
    locked = tmp_path / "locked"
    locked.mkdir(mode=0o500)
    if not os.access(locked, os.W_OK):  # root may write everywhere
        with pytest.raises(OutputError, match="can be written"):
            check_place(locked / "int8")


def test_a_place_that_cannot_be_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for place in (Path(), tmp_path):
        with pytest.raises(OutputError, match="the folder that this runs in"):
            check_place(place)
    (tmp_path / "mounted").mkdir()
    monkeypatch.setattr(Path, "is_mount", lambda path: path.name == "mounted")
    with pytest.raises(OutputError, match="a folder within it"):
        check_place(tmp_path / "mounted")


def test_a_budget_that_cannot_be_met_keeps_and_names_the_best(
    toy_directory: Path, tiny_drive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever is adjusted or given back, points are lost; fewer layers in INT8 lose less."""
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    lost = iter([9.0, 8.0, 8.5, 8.7, 7.0, 5.0, 3.0, *[4.0] * 50])
    known: list[float] = []

    def points(budget: Budget, before: object, after: object) -> float:
        if before is after:
            return 0.0
        known.append(next(lost))
        return known[-1]

    monkeypatch.setattr(Budget, "lost", points)
    second = Path(shutil.copytree(tiny_drive, tmp_path / "second"))
    for path in (second / "training" / "image_2").iterdir():
        cv2.imwrite(str(path), cv2.imread(str(path)) // 2)
    out = tmp_path / "int8"
    line = complaint(
        *(toy_directory, "--out", out, "--calibration", f"kitti-object:{tiny_drive}", "--target", "x86-vnni"),
        *("--validation", f"kitti-object:{second}", "--max-drop", 0.5),
        code=1,
    )
    assert f"found {min(known):+.2f} points lost by the best of {len(known)} models" in line
    assert f"kept in {out}" in line
    assert "allow more" in line
    kept = open_model_directory(out).manifest.provenance["given_back_to_float"].split()
    steps = json.loads((out / "report.json").read_text(encoding="utf-8"))["quantisation"]["budget"]
    best = min(steps, key=lambda step: step["lost"])
    assert kept == sorted(best["given_back"])
    assert not any(step["holds"] for step in steps)
