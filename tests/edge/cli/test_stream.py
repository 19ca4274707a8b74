"""`edge stream` from end to end on a tiny model and a tiny drive."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from edge.cli.main import app

DEPTH_TOLERANCE_M = 1e-4
"""Float32 network arithmetic on depths of some 20 m."""
REPOSITORY = Path(__file__).resolve().parents[3]


def stream(*words: str | Path) -> object:
    result = CliRunner().invoke(app, ["stream", *map(str, words)])
    assert result.exit_code == 0, result.output
    return result


def test_without_any_sink_it_still_tells_the_latency(tiny_model: Path, tiny_drive: Path) -> None:
    output = stream(tiny_model, "--source", f"kitti-object:{tiny_drive}").output
    for word in ("p50", "p90", "p99", "max", "read", "preprocess", "inference", "decode", "total", "4 frames"):
        assert word in output


def test_json_lines_have_one_record_a_frame_of_the_right_pair(
    tiny_model: Path, tiny_drive: Path, tmp_path: Path
) -> None:
    target = tmp_path / "out" / "result.jsonl"
    stream(tiny_model, "--source", f"kitti-object:{tiny_drive}", "--json", target)
    records = [json.loads(line) for line in target.read_text(encoding="utf-8").splitlines()]
    assert [record["frame_id"] for record in records] == ["000000", "000001", "000002", "000003"]
    assert [record["timestamp_secs"] for record in records] == [0.0, 0.1, 0.2, 0.3]
    for number, record in enumerate(records):
        assert set(record) == {"frame_id", "timestamp_secs", "detections", "latency_ms"}
        (found,) = record["detections"]
        assert set(found) == {"class", "score", "box2d", "center", "size_hwl", "yaw", "alpha"}
        assert found["class"] == "Car"
        assert found["center"][2] == pytest.approx(20 + 10 * 40 * number / 255, abs=DEPTH_TOLERANCE_M)
        assert len(found["box2d"]) == 4
        assert {"read", "preprocess", "inference", "decode", "total"} <= set(record["latency_ms"])


def test_json_to_standard_output_leaves_it_to_records_alone(tiny_model: Path, tiny_drive: Path) -> None:
    result = stream(tiny_model, "--source", f"kitti-object:{tiny_drive}?limit=2", "--json", "-")
    assert len([json.loads(line) for line in result.stdout.splitlines()]) == 2
    assert "p50" in result.stderr


def test_kitti_text_video_and_pictures(tiny_model: Path, tiny_drive: Path, tmp_path: Path) -> None:
    kitti, video, pictures = tmp_path / "kitti", tmp_path / "run.mp4", tmp_path / "pictures"
    uri = f"kitti-object:{tiny_drive}?split=val"
    output = stream(
        tiny_model, "--source", uri, "--kitti", kitti, "--video", video, "--pictures", pictures, "--labels"
    ).output
    assert sorted(path.name for path in kitti.iterdir()) == ["000002.txt", "000003.txt"]
    assert sorted(path.name for path in pictures.iterdir()) == ["000002.jpg", "000003.jpg"]
    capture = cv2.VideoCapture(str(video))
    assert int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) == 2
    capture.release()
    assert str(video) in output.replace("\n", "")


def test_a_dark_frame_gives_an_empty_file(tiny_model: Path, tiny_drive: Path, tmp_path: Path) -> None:
    dark = tiny_drive / "training" / "image_2" / "000001.png"
    assert cv2.imwrite(str(dark), 0 * cv2.imread(str(dark)))
    stream(tiny_model, "--source", f"kitti-object:{tiny_drive}", "--kitti", tmp_path / "kitti")
    assert (tmp_path / "kitti" / "000001.txt").read_text(encoding="utf-8") == ""
    assert (tmp_path / "kitti" / "000002.txt").read_text(encoding="utf-8").startswith("Car -1 -1 ")


def test_score_is_the_least_score(tiny_model: Path, tiny_drive: Path) -> None:
    uri = f"kitti-object:{tiny_drive}?limit=1"
    above = stream(tiny_model, "--source", uri, "--score", "0.999", "--json", "-").stdout
    below = stream(tiny_model, "--source", uri, "--score", "0.9", "--json", "-").stdout
    assert [len(json.loads(text)["detections"]) for text in (above, below)] == [0, 1]


def test_overwrite_replaces_results(tiny_model: Path, tiny_drive: Path, tmp_path: Path) -> None:
    target = tmp_path / "result.jsonl"
    target.write_text("old\n", encoding="utf-8")
    stream(tiny_model, "--source", f"kitti-object:{tiny_drive}", "--json", target, "--overwrite")
    assert "old" not in target.read_text(encoding="utf-8")


def test_a_somewhat_different_rig_is_noted_once(tiny_model: Path, tiny_drive: Path) -> None:
    for path in (tiny_drive / "training" / "calib").iterdir():
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("-1.000000000000e+02", "-1.100000000000e+02"), encoding="utf-8")
    result = stream(tiny_model, "--source", f"kitti-object:{tiny_drive}")
    assert result.stderr.count("baseline") == 1


def test_a_far_rig_passes_when_allowed(tiny_model: Path, tiny_drive: Path) -> None:
    for path in (tiny_drive / "training" / "calib").iterdir():
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("-1.000000000000e+02", "-2.000000000000e+02"), encoding="utf-8")
    result = stream(tiny_model, "--source", f"kitti-object:{tiny_drive}", "--allow-other-rig")
    assert "baseline" in result.stderr


WITHOUT_WORKBENCH = """
import importlib.abc, sys
class Refuse(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {"torch", "onnx", "onnxscript", "onnxsim", "safetensors", "depthai", "moderngl",
                                      "matplotlib", "scipy", "shapely", "av", "PIL"}:
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Refuse())
from edge.cli.main import main
main()
"""


@pytest.mark.parametrize("command", ["stream", "doctor"])
def test_runs_where_only_the_slim_packages_are(command: str, tiny_model: Path, tiny_drive: Path) -> None:
    words = [command] if command == "doctor" else [command, str(tiny_model), "--source", f"kitti-object:{tiny_drive}"]
    result = subprocess.run(
        [sys.executable, "-c", WITHOUT_WORKBENCH, *words], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert result.returncode == 0, result.stderr
