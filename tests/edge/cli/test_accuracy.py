"""``edge accuracy`` from end to end on a toy recording: figures, files, exit codes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib.choice_record import choice_text
from calib.frames import CalibrationSet, ChosenFrame, geometry_hash, pixel_hash
from edge.cli.main import app
from edge.evaluation.text_folders import read_text_frames
from runtime.contracts.kitti import parse_detections
from runtime.model_folder import CALIBRATION_FILE
from runtime.sources.factory import open_sequence

SHIFT_TOLERANCE_M = 1e-4  # float32 head outputs decoded at 20 m
SHIFT_M = 0.75
# the two cars that both models find move along their rays: x / z is -0.4 and 0.56, y / z is 0.08
SHIFT_ALONG_RAYS_M = SHIFT_M * (np.linalg.norm([-0.4, 0.08, 1.0]) + np.linalg.norm([0.56, 0.08, 1.0])) / 2


def run(*arguments: object) -> int:
    from typer.main import get_command

    with pytest.raises(SystemExit) as ended:
        get_command(app).main([str(item) for item in arguments])
    return int(ended.value.code or 0)


@pytest.fixture
def source(toy_recording: Path) -> str:
    return f"kitti-object:{toy_recording}?split=val"


def test_no_frame_is_refused(toy_model: Callable[..., Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert run("accuracy", toy_model("fp32"), "--source", f"kitti-object:{tmp_path}/none") == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_figures_of_two_models(toy_model: Callable[..., Path], source: str, tmp_path: Path):
    reference, other = toy_model("fp32"), toy_model("int8", scores=(0.9, 0.0, 0.7), shift_m=SHIFT_M)
    target = tmp_path / "figures.json"
    assert run("accuracy", reference, other, "--source", source, "--json", target) == 0
    record = json.loads(target.read_text())
    assert set(record) == {"models", "against_first"}
    first, second = record["models"]
    assert set(first) == {"path", "ap", "frames", "objects"}
    assert (first["path"], first["frames"]) == (str(reference), 6)
    assert set(first["ap"]) == {"Car", "Pedestrian"}  # the model's own classes
    assert first["objects"]["Car"] == [15, 15, 15]
    (against,) = record["against_first"]
    assert set(against) == {"drop", "interval95", "matched_share", "centre_error_m"}
    assert against["matched_share"] == pytest.approx(2 * 12 / (18 + 12))
    assert against["centre_error_m"]["all"]["median"] == pytest.approx(SHIFT_ALONG_RAYS_M, abs=SHIFT_TOLERANCE_M)
    points = against["drop"]["Car"]["3d"]["0.7"]["R40"]
    expected = [
        left - right
        for left, right in zip(
            first["ap"]["Car"]["3d"]["0.7"]["R40"], second["ap"]["Car"]["3d"]["0.7"]["R40"], strict=True
        )
    ]
    assert points == expected
    assert points[1] > 0
    low, high = against["interval95"]["Car"]["3d"]["0.7"]["R40"][1]
    assert low <= points[1] <= high


def test_frames_that_calibrated_a_model_are_said(
    toy_model: Callable[..., Path], source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    with open_sequence(source) as frames:
        frame = frames[2]
    calibrated = ChosenFrame("elsewhere/000077", 7, pixel_hash(frame), geometry_hash(frame.geometry))
    strange = ChosenFrame(frame.frame_id, 2, "0" * 16, calibrated.geometry)
    models = [toy_model("fp32")]
    for name, chosen in (("int8", calibrated), ("other", strange)):
        models.append(toy_model(name))
        text = choice_text(CalibrationSet("kitti-object:elsewhere", (chosen,), 60, "spread"))
        (models[-1] / CALIBRATION_FILE).write_text(text, encoding="utf-8")
    assert run("accuracy", *models, "--source", source) == 0
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "calibrated" in line]
    assert line.startswith(f"warning: {models[1]}: 1 of the measured frames calibrated, too (the first is 000002)")


def test_a_damaged_record_of_calibration_frames_is_one_line(
    toy_model: Callable[..., Path], source: str, capsys: pytest.CaptureFixture[str]
):
    model = toy_model("int8")
    (model / CALIBRATION_FILE).write_text("{", encoding="utf-8")
    assert run("accuracy", model, "--source", source) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert f"{model / CALIBRATION_FILE}: found no record" in said


def test_a_model_against_itself_loses_nothing(toy_model: Callable[..., Path], source: str, tmp_path: Path):
    model, target = toy_model("same"), tmp_path / "figures.json"
    assert run("accuracy", model, model, "--source", source, "--json", target) == 0
    (against,) = json.loads(target.read_text())["against_first"]
    assert against["matched_share"] == 1.0
    assert against["drop"]["Car"]["2d"]["0.7"]["R40"] == [0.0] * 3
    assert against["interval95"]["Car"]["2d"]["0.7"]["R40"] == [[0.0, 0.0]] * 3
    assert against["centre_error_m"]["all"] == {"median": 0.0, "mean": 0.0}


def test_folder_holds_report_pictures_and_detections(
    toy_model: Callable[..., Path], toy_recording: Path, source: str, tmp_path: Path
):
    reference, other = toy_model("fp32"), toy_model("int8", scores=(0.9, 0.0, 0.7))
    out = tmp_path / "out"
    assert run("accuracy", reference, other, "--source", source, "--out", out) == 0
    text = (out / "report.md").read_text()
    assert "Labelled objects" in text
    assert "int8 against fp32" in text
    pictures = sorted((out / "pictures" / "int8").glob("*.jpg"))
    assert len(pictures) == 6
    assert all(f"pictures/int8/{picture.name}" in text for picture in pictures)
    assert cv2.imread(str(pictures[0])) is not None
    record = json.loads((out / "report.json").read_text())
    assert record["models"][0]["interval95"]["Car"]["3d"]["0.7"]["R40"]
    assert record["models"][0]["latency_ms"]["inference"] > 0
    # the written detections give the same AP when they are evaluated as text
    frames = read_text_frames(toy_recording / "training" / "label_2", out / "detections" / "fp32")
    assert [len(item) for item in frames.detections] == [3] * 6


def test_recording_without_labels_gives_agreement_only(
    toy_model: Callable[..., Path], toy_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bare = tmp_path / "bare"
    shutil.copytree(toy_recording, bare)
    shutil.rmtree(bare / "training" / "label_2")
    target = tmp_path / "figures.json"
    models = toy_model("fp32"), toy_model("int8", scores=(0.9, 0.8, 0.0))
    assert run("accuracy", *models, "--source", f"kitti-object:{bare}?split=val", "--json", target) == 0
    record = json.loads(target.read_text())
    assert [item["ap"] for item in record["models"]] == [{}, {}]
    assert record["against_first"][0]["drop"] == {}
    assert record["against_first"][0]["matched_share"] == pytest.approx(2 * 12 / (18 + 12))
    assert "no labels" in capsys.readouterr().out


def test_partly_labelled_recording_says_so(
    toy_model: Callable[..., Path], toy_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    part = tmp_path / "part"
    shutil.copytree(toy_recording, part)
    (part / "training" / "label_2" / "000003.txt").unlink()
    assert run("accuracy", toy_model("fp32"), "--source", f"kitti-object:{part}?split=val") == 0
    assert "5 of 6 frames have labels" in capsys.readouterr().out


@pytest.mark.parametrize("flag", [[], ["--overwrite"]])
def test_folder_with_files_needs_overwrite(
    toy_model: Callable[..., Path], source: str, tmp_path: Path, flag: list[str], capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "kept.txt").write_text("")
    (tmp_path / "detections" / "fp32").mkdir(parents=True)
    (tmp_path / "detections" / "fp32" / "000004.txt").write_text("")
    code = run("accuracy", toy_model("fp32"), "--source", f"{source}&limit=1", "--out", tmp_path, *flag)
    assert code == (0 if flag else 2)
    assert (tmp_path / "report.md").exists() is bool(flag)
    if flag:
        found = parse_detections((tmp_path / "detections" / "fp32" / "000000.txt").read_text())
        assert len(found) == 3
        assert "1 text files of an earlier run" in capsys.readouterr().err


def test_broken_second_model_is_said_before_the_first_runs(
    toy_model: Callable[..., Path], source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    broken = toy_model("broken")
    (broken / "model.onnx").write_bytes(b"changed")
    assert run("accuracy", toy_model("fp32"), broken, "--source", source) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "sha256" in captured.err


def test_unknown_source_option_is_refused(toy_model: Callable[..., Path], capsys: pytest.CaptureFixture[str]):
    assert run("accuracy", toy_model("fp32"), "--source", "kitti-object:/nowhere?unknown=1") == 2
    assert "unknown option" in capsys.readouterr().err


def test_split_by_distance_and_occlusion_with_pictures(
    toy_model: Callable[..., Path], source: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    target, pictures = tmp_path / "figures.json", tmp_path / "errors"
    model = toy_model("int8", scores=(0.9, 0.0, 0.7))
    options = ["--by", "distance, occlusion", "--pictures", pictures, "--top", 2, "--json", target]
    assert run("accuracy", model, "--source", source, *options) == 0
    (branch,) = json.loads(target.read_text())["models"]
    rows = branch["breakdown"]["rows"]
    assert {row["kind"] for row in rows} == {"distance", "occlusion"}
    visible = next(row for row in rows if (row["kind"], row["band"]) == ("occlusion", "visible"))
    assert (visible["objects"], visible["found"]) == (15, 9)  # a car is missed in each frame, one unlabelled in three
    listed = json.loads((pictures / "cases.json").read_text())
    assert [item["kind"] for item in listed].count("missed") == 2
    assert all((pictures / item["picture"]).is_file() for item in listed)
    said = capsys.readouterr().out
    assert "objects found and missed by occlusion" in said
    assert "inventions by distance" in said
    assert str(pictures) in said


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--by", "colour"], "distance, occlusion, truncation"),
        (["--by", ","], "distance, occlusion, truncation"),
        (["--by", "distance,distance"], "distance, occlusion, truncation"),
    ],
)
def test_a_wrong_split_is_one_line(toy_model, source, options, said, capsys):
    assert run("accuracy", toy_model("fp32"), "--source", source, *options) == 2
    captured = capsys.readouterr().err
    assert captured.count("\n") == 1
    assert said in captured


def test_a_split_without_labels_is_refused_before_the_model_runs(
    toy_model: Callable[..., Path], toy_recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    bare = tmp_path / "bare"
    shutil.copytree(toy_recording, bare)
    shutil.rmtree(bare / "training" / "label_2")
    for options in (["--by", "distance"], ["--pictures", tmp_path / "errors"]):
        assert run("accuracy", toy_model("fp32"), "--source", f"kitti-object:{bare}?split=val", *options) == 2
        captured = capsys.readouterr().err
        assert captured.count("\n") == 1
        assert f"{options[0]}: found no labels" in captured
    assert run("accuracy", toy_model("a"), toy_model("b"), "--source", "x:y", "--pictures", tmp_path / "errors") == 2
    assert "--pictures with 2 models" in capsys.readouterr().err
