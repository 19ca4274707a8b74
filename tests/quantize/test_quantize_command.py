"""``edge quantize`` from end to end on the toy network: files, report, cache, budget, exit codes."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.main import get_command

pytest.importorskip("onnx")

from calib.choice_record import read_choice
from calib.methods import METHODS
from edge.cli.main import app
from edge.cli.source_names import public_name
from runtime.contracts.manifest import open_model_directory
from runtime.detector import open_detector
from runtime.sources.factory import open_source


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        get_command(app).main([str(item) for item in arguments])
    return int(ended.value.code or 0)


@pytest.fixture(autouse=True)
def cache_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def drives(tiny_drive: Path) -> tuple[Path, Path]:
    """Two drives with other pictures; the second one measures."""
    import cv2

    second = Path(shutil.copytree(tiny_drive, tiny_drive.parent / "second-drive"))
    for seed, drive in enumerate((tiny_drive, second)):
        random = np.random.default_rng(seed)
        for folder in ("image_2", "image_3"):
            for path in sorted((drive / "training" / folder).iterdir()):
                coarse = random.integers(0, 256, (8, 16, 3)).astype(np.uint8)
                assert cv2.imwrite(str(path), cv2.resize(coarse, (128, 64), interpolation=cv2.INTER_CUBIC))
    return tiny_drive, second


@pytest.fixture
def arguments(toy_directory: Path, drives: tuple[Path, Path]) -> list[object]:
    source = f"kitti-object:{drives[0]}"
    return ["quantize", toy_directory, "--calibration", source, "--target", "x86-vnni", "--method", "mse"]


def label_with_own_detections(model: Path, drive: Path) -> int:
    """Replaces the labels by what the float model finds, so that it has an AP to lose; returns how many."""
    count = 0
    with open_source(f"kitti-object:{drive}") as source, open_detector(model) as detector:
        for frame in source:
            found, _ = detector(frame)
            lines = []
            for row in range(min(len(found), 6)):
                x1, y1, x2, y2 = found.box_in_left_image[row]
                h, w, length = np.maximum(found.size_hwl[row], 0.5)
                x, y, z = found.center_in_camera[row]
                lines.append(
                    f"Car 0.00 0 {found.alpha_rad[row]:.2f} {x1:.2f} {y1:.2f} {x2:.2f} {max(y2, y1 + 45):.2f} "
                    f"{h:.2f} {w:.2f} {length:.2f} {x:.2f} {y + h / 2:.2f} {z:.2f} {found.yaw_rad[row]:.2f}\n"
                )
            count += len(lines)
            path = drive / "training" / "label_2" / f"{frame.frame_id}.txt"
            path.write_text("".join(lines), encoding="utf-8")
    return count


def test_a_model_and_its_report_come_out(arguments, drives, tmp_path, capsys) -> None:
    out = tmp_path / "int8"
    validation = ["--validation", f"kitti-object:{drives[1]}"]
    assert run(*arguments, "--frames", 3, "--out", out, *validation, "--method", "search") == 0
    assert open_model_directory(out).manifest.recipe == "static_wi8_au8_x86_vnni"
    assert open_model_directory(out).manifest.provenance["int8_range_method"].startswith("search from ")
    names = {path.name for path in out.iterdir()}
    written = {"model.onnx", "manifest.json", "priors.npz", "card.md", "report.md", "report.json", "ranges.png"}
    written |= {"calibration.json"}
    assert names - {"report-pictures"} == written
    record = json.loads((out / "report.json").read_text(encoding="utf-8"))
    done = record["quantisation"]
    assert [frame["frame_id"] for frame in done["calibration_frames"]] == [
        frame.frame_id for frame in read_choice(out).frames
    ]
    assert done["calibration_frames"][0]["frame_id"] != done["calibration_frames"][1]["frame_id"]
    assert done["int8_share_of_multiply_adds"]["graph"] == 1.0
    assert len(done["layers"]) == 14
    assert len(done["latency"]) == 2
    if Path("/proc/self/status").is_file():
        assert all(item["peak_mib"] > item["before_mib"] > 0 for item in done["memory"])
    shown = record["evidence"]
    assert {change["picture"] for change in shown["changes"] if change["picture"]} <= {
        path.relative_to(out).as_posix() for path in out.glob("report-pictures/*.jpg")
    }
    for row in shown["ap_by_distance"]:
        assert row["objects"] > 0
        assert row["drop"] == pytest.approx(row["reference"] - row["other"])
    assert record["against_first"][0]["matched_share"] <= 1.0
    text = (out / "report.md").read_text(encoding="utf-8")
    for part in ("Signal-to-noise", "Cost on this machine", "What stayed float", "static_wi8_au8_x86_vnni"):
        assert part in text
    assert record["parity"]["passed"] is True
    assert {check["what"] for check in record["parity"]["checks"]} >= {"pixels, left view", "pixels, right view"}
    assert "### To repeat it" in text
    words = record["repeat"]["command"]
    assert words[:3] == ["edge", "quantize", "tiny-model"]
    again = get_command(app).get_command(None, "quantize").make_context("quantize", words[2:])
    assert again.params["frames"] == 3
    assert again.params["target"] == "x86-vnni"
    assert again.params["validation"] == "kitti-object:second-drive"
    assert record["repeat"]["sha256"]["the INT8 model"] == open_model_directory(out).manifest.sha256["model.onnx"]
    assert str(tmp_path) not in json.dumps(record), "no path of this machine"
    assert str(tmp_path) not in text + (out / "manifest.json").read_text(encoding="utf-8"), "no path of this machine"
    told = capsys.readouterr().err
    assert "calibrated on 3 frames of kitti-object:tiny-drive (run)" in told
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []

    before = (out / "model.onnx").read_bytes()
    assert run(*arguments, "--frames", 3, "--out", out, *validation, "--method", "search") == 0
    assert "remembered from an earlier run" in capsys.readouterr().err
    assert (out / "model.onnx").read_bytes() == before

    (out / "report-pictures").mkdir(exist_ok=True)
    (out / "report-pictures" / "notes.txt").write_text("mine")
    assert run(*arguments, "--frames", 3, "--out", out, *validation) == 2
    assert "files of your own" in capsys.readouterr().err
    assert (out / "report-pictures" / "notes.txt").read_text() == "mine"


def test_measuring_on_calibration_frames_is_refused_unless_allowed(arguments, drives, tmp_path, capsys) -> None:
    validation = ["--validation", f"kitti-object:{drives[0]}"]
    assert run(*arguments, "--out", tmp_path / "int8", *validation) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error:")]
    assert "found 4 frames that calibrate, too (the first is 000000)" in line
    assert "--allow-overlap" in line
    assert not (tmp_path / "int8").exists()
    assert run(*arguments, "--out", tmp_path / "int8", *validation, "--allow-overlap") == 0
    assert "4 of the measured frames calibrated, too" in capsys.readouterr().err


def test_a_budget_is_kept_or_missed_with_the_best_named(arguments, drives, tmp_path, toy_directory, capsys) -> None:
    assert label_with_own_detections(toy_directory, drives[1]) > 0
    validation = ["--validation", f"kitti-object:{drives[1]}"]
    out = tmp_path / "wide"
    assert run(*arguments, "--out", out, *validation, "--max-drop", 100) == 0
    (step,) = json.loads((out / "report.json").read_text(encoding="utf-8"))["quantisation"]["budget"]
    assert (out / "budget.png").stat().st_size > 0
    assert step["given_back"] == []
    assert step["adjustments"] == "weights rounded by what they do"
    assert step["holds"]
    drop = step["lost"]
    assert drop > 0, "the toy network must lose something for this test to say anything"
    capsys.readouterr()

    out = tmp_path / "narrow"
    code = run(*arguments, "--out", out, *validation, "--max-drop", drop / 2)
    steps = json.loads((out / "report.json").read_text(encoding="utf-8"))["quantisation"]["budget"]
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    provenance = open_model_directory(out).manifest.provenance
    kept = provenance["given_back_to_float"]
    holding = [item for item in steps if item["holds"]]
    assert len(steps) > 1
    assert code == (0 if holding else 1)
    if holding:
        best = min(holding, key=lambda item: (item["inference_ms"], len(item["given_back"])))
    else:
        best = min(steps, key=lambda item: item["lost"])
        assert str(out) in capsys.readouterr().err
    assert kept == (" ".join(sorted(best["given_back"])) or "none")
    assert {item["adjustments"] for item in steps if not item["given_back"]} == set(ADJUSTMENTS)
    assert provenance["int8_adjustments"] == best["adjustments"] == report["facts"]["adjustments"]
    repeated = report["repeat"]["recipe"]
    assert (repeated["output_rounding"], repeated["bias_correction"]) == ADJUSTMENTS[best["adjustments"]]
    assert f"; {best['adjustments']}." in (out / "card.md").read_text(encoding="utf-8")


ADJUSTMENTS = {
    "weights rounded by what they do": (True, False),
    "weights rounded by what they do, biases corrected": (True, True),
    "weights to the nearest level": (False, False),
    "weights to the nearest level, biases corrected": (False, True),
}
"""What a budget tries at no cost, and what the recipe says then: rounding, correction."""


@pytest.mark.parametrize(
    ("extra", "said"),
    [
        (["--max-drop", "1"], "--validation"),
        (["--max-disagreement", "1"], "--validation"),
        (["--max-disagreement", "1", "--max-drop", "1", "--validation", "images:a,b"], "one budget"),
        (["--target", "z80"], "--target"),
        (["--calibration", "kitti-object:nowhere"], "nowhere"),
        (["--method", "guess"], "guess"),
        (["--frames", "0"], "frames"),
    ],
)
def test_wrong_input_is_one_line(arguments, extra, said, tmp_path, capsys) -> None:
    assert run(*arguments, "--out", tmp_path / "int8", *extra) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len([line for line in lines if line.startswith("error:")]) == 1
    assert said in lines[-1]
    assert not (tmp_path / "int8").exists()


def test_a_budget_without_labels_is_refused(arguments, drives, tmp_path, capsys) -> None:
    shutil.rmtree(drives[1] / "training" / "label_2")
    validation = ["--validation", f"kitti-object:{drives[1]}", "--max-drop", 1]
    assert run(*arguments, "--out", tmp_path / "int8", *validation) == 2
    assert "no labelled objects" in capsys.readouterr().err
    assert not (tmp_path / "int8").exists()


def test_without_labels_the_budget_is_agreement(arguments, drives, tmp_path) -> None:
    shutil.rmtree(drives[1] / "training" / "label_2")
    validation = ["--validation", f"kitti-object:{drives[1]}", "--max-disagreement", 100]
    out = tmp_path / "int8"
    assert run(*arguments, "--out", out, *validation) == 0
    record = json.loads((out / "report.json").read_text(encoding="utf-8"))["quantisation"]
    (step,) = record["budget"]
    assert step["holds"]
    assert record["budget_unit"] == "% of detections unlike"
    assert "% of detections unlike" in (out / "report.md").read_text(encoding="utf-8")
    assert 0 < step["lost"] <= 100, "the toy network must disagree somewhere for this test to say anything"


def test_a_budget_of_shift_needs_near_boxes(arguments, drives, tmp_path, capsys) -> None:
    """The toy network shows none within 30 m: said once the float model was measured, before anything is built."""
    validation = ["--validation", f"kitti-object:{drives[1]}", "--max-shift", 5]
    assert run(*arguments, "--out", tmp_path / "int8", *validation) == 2
    told = capsys.readouterr().err
    assert "no box of the float model within 30 m" in told.strip().splitlines()[-1]
    assert "layers in float" not in told
    assert not (tmp_path / "int8").exists()


def test_a_live_source_does_not_calibrate(arguments, tmp_path, monkeypatch, capsys) -> None:
    """A camera's frames cannot be had twice: hashed and observed ones would differ."""

    class Camera:
        uri = "oak:"
        is_live = True

    monkeypatch.setattr("runtime.sources.factory.open_source", lambda uri: Camera())
    assert run(*arguments, "--out", tmp_path / "int8", "--calibration", "oak:") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()[-1:]
    assert "oak: is live" in line
    assert not (tmp_path / "int8").exists()


def test_frames_of_another_camera_are_refused(arguments, drives, tmp_path, capsys) -> None:
    for path in (drives[0] / "training" / "calib").iterdir():
        path.write_text(path.read_text(encoding="utf-8").replace("2.0000", "4.0000"), encoding="utf-8")
    assert run(*arguments, "--out", tmp_path / "int8") == 2
    assert "--allow-other-rig" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("uri", "shown"),
    [
        ("kitti-object:/data/kitti/object?split=train", "kitti-object:object?split=train"),
        ("images:/a/l/*.png,/a/r/*.png?geometry=/a/rig.json&limit=5", "images:*.png,*.png?limit=5"),
        ("kitti-raw:drive", "kitti-raw:drive"),
        ("images:/a/l/?.png,/a/r/?.png?geometry=/a/rig.json&limit=5", "images:?.png,?.png?limit=5"),
        ("images:/a/l/0?.png,/a/r/0?.png?geometry=/a/rig.json", "images:0?.png,0?.png"),
        ("kitti-object:/a/what?x=1/object?split=/a/train", "kitti-object:object?split=train"),
        ("video:/a/l.mp4,/a/r.mp4?limit=3&geometry=/a/rig.json&rate", "video:l.mp4,r.mp4?limit=3&rate=camera"),
        ("oak:", "oak:"),
    ],
)
def test_names_of_sources_hold_no_folders(uri, shown) -> None:
    assert public_name(uri) == shown


def test_a_curve_of_searched_ranges_says_where_its_own_come_from(arguments, drives, tmp_path, capsys) -> None:
    out = tmp_path / "int8"
    validation = ("--validation", f"kitti-object:{drives[0]}", "--allow-overlap")
    assert run(*arguments, "--method", "search", "--out", out, *validation, "--curve", "1") == 0
    told = capsys.readouterr().err
    method = json.loads((out / "curve.json").read_text(encoding="utf-8"))["range_method"]
    assert method in METHODS
    assert f"curve: ranges by {method} alone, not searched" in told
    assert "spread: 1 of the measured frames calibrated, too" in told  # its own choice, not only the model's
    facts = json.loads((out / "report.json").read_text(encoding="utf-8"))["facts"]
    assert facts["ranges"].startswith(f"search from {method}")
    assert f"with {method} ranges" in facts["error at the outputs"]


def test_a_curve_that_cannot_be_measured_leaves_the_model(arguments, drives, tmp_path, capsys) -> None:
    """The bundled drive that measures has another camera than the toy network."""
    out = tmp_path / "int8"
    assert run(*arguments, "--out", out, "--curve", "1") == 0
    assert "no curve: rig" in capsys.readouterr().err
    assert open_model_directory(out).manifest.recipe == "static_wi8_au8_x86_vnni"
    assert not (out / "curve.json").exists()


def test_a_curve_over_the_number_of_frames(arguments, drives, tmp_path, capsys) -> None:
    out = tmp_path / "int8"
    assert run(*arguments, "--out", out, "--validation", f"kitti-object:{drives[1]}", "--curve", "1,3") == 0
    record = json.loads((out / "curve.json").read_text(encoding="utf-8"))
    points = record["points"]
    assert record["range_method"] == "mse"
    assert [(item["choice"], item["frames"]) for item in points] == [
        ("coverage", 1), ("coverage", 3), ("spread", 1), ("spread", 3),
    ]  # fmt: skip
    assert all(0 <= item["matched_share"] <= 1 for item in points)
    for way in ("coverage", "spread"):  # of a choice and its own first frames
        one, three = (item["coverage"] for item in points if item["choice"] == way)
        assert one <= three
    assert (out / "curve.png").stat().st_size > 0
    assert "curve:    3 frames by spread" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir() if path.name.startswith(".")) == []


@pytest.mark.parametrize("curve", ["", "4,1", "1,1", "0,1", "many", "1,,2"])
def test_a_wrong_curve_is_one_line(arguments, curve, tmp_path, capsys) -> None:
    assert run(*arguments, "--out", tmp_path / "int8", "--curve", curve) == 2
    assert "--curve: found" in capsys.readouterr().err
    assert not (tmp_path / "int8").exists()
