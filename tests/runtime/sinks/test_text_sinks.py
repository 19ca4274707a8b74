"""JSON lines and KITTI text."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.errors import OutputError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_detections
from runtime.contracts.objects import Detections3D
from runtime.sinks.base import FrameResult
from runtime.sinks.jsonl import JsonLinesSink, record
from runtime.sinks.kitti_txt import KittiTextSink
from runtime.sinks.places import claim_file, claim_folder

NAMES = ("Car", "Pedestrian")
TEXT_TOLERANCE = 1e-6
"""KITTI text and JSON lines carry six decimals."""


def frame(frame_id: str = "000007") -> StereoFrame:
    left = np.array([[10.0, 0, 4, 0], [0, 10.0, 2, 0], [0, 0, 1, 0]])
    right = left - np.array([[0, 0, 0, 5.0], [0, 0, 0, 0], [0, 0, 0, 0]])
    view = np.zeros((4, 8, 3), np.uint8)
    return StereoFrame(view, view, 0.7, 7, frame_id, StereoGeometry(left, right, (8, 4)))


def two_boxes() -> Detections3D:
    return Detections3D(
        class_id=np.array([1, 0]),
        score=np.array([0.5, 0.25]),
        box_in_left_image=np.array([[1.0, 2.0, 3.0, 4.0], [0.5, 0.0, 8.0, 4.0]]),
        center_in_camera=np.array([[1.0, 0.5, 12.0], [-3.0, 1.0, 30.0]]),
        size_hwl=np.array([[1.8, 0.6, 0.8], [1.5, 1.6, 3.9]]),
        alpha_rad=np.array([0.1, -1.5]),
        yaw_rad=np.array([0.2, 3.1]),
        class_names=NAMES,
    )


def result(detections: Detections3D, frame_id: str = "000007") -> FrameResult:
    return FrameResult(frame(frame_id), detections, {"inference": 1.23456, "total": 2.0})


def test_record_of_an_empty_frame() -> None:
    assert record(result(Detections3D.empty(NAMES))) == {
        "frame_id": "000007",
        "timestamp_secs": 0.7,
        "detections": [],
        "latency_ms": {"inference": 1.235, "total": 2.0},
    }


def test_record_of_boxes() -> None:
    (first, second) = record(result(two_boxes()))["detections"]
    assert first == {
        "class": "Pedestrian",
        "score": 0.5,
        "box2d": [1.0, 2.0, 3.0, 4.0],
        "center": [1.0, 0.5, 12.0],
        "size_hwl": [1.8, 0.6, 0.8],
        "yaw": 0.2,
        "alpha": 0.1,
    }
    assert second["class"] == "Car"


def test_json_lines_can_be_read_while_they_are_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "out.jsonl"
    with JsonLinesSink(str(path)) as sink:
        for count in range(1, 3):
            sink.write(result(two_boxes()))
            assert len(path.read_text(encoding="utf-8").splitlines()) == count
    assert all(json.loads(line) for line in path.read_text(encoding="utf-8").splitlines())
    assert sink.summary() == f"2 records in {path}"


def test_json_to_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    with JsonLinesSink("-") as sink:
        sink.write(result(two_boxes()))
    assert json.loads(capsys.readouterr().out)["frame_id"] == "000007"


def test_a_sink_that_was_not_entered(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="enter it"):
        JsonLinesSink(str(tmp_path / "a")).write(result(two_boxes()))


def test_kitti_text_round_trip(tmp_path: Path) -> None:
    with KittiTextSink(tmp_path / "kitti") as sink:
        sink.write(result(two_boxes()))
        sink.write(result(Detections3D.empty(NAMES), "0010/000003"))
    again = parse_detections((tmp_path / "kitti" / "000007.txt").read_text(encoding="utf-8"), NAMES)
    assert again.class_id.tolist() == [1, 0]
    np.testing.assert_allclose(again.center_in_camera, two_boxes().center_in_camera, atol=TEXT_TOLERANCE)
    np.testing.assert_allclose(again.yaw_rad, two_boxes().yaw_rad, atol=TEXT_TOLERANCE)
    assert (tmp_path / "kitti" / "0010" / "000003.txt").read_text(encoding="utf-8") == ""
    assert sink.summary() == f"2 KITTI text files in {tmp_path / 'kitti'}"


def test_kitti_overwrite_tells_of_older_files(tmp_path: Path) -> None:
    (tmp_path / "000001.txt").write_text("", encoding="utf-8")
    with KittiTextSink(tmp_path, overwrite=True) as sink:
        sink.write(result(two_boxes()))
    assert "1 older" in sink.summary()
    assert (tmp_path / "000001.txt").exists()


def test_kitti_text_counts_files_and_keeps_none_in_mind(tmp_path: Path) -> None:
    for name in ("000001", "000002"):
        (tmp_path / f"{name}.txt").write_text("", encoding="utf-8")
    with KittiTextSink(tmp_path, overwrite=True) as sink:
        for name in ("000002", "000003", "000003", "0010/000004"):  # one older, one twice
            sink.write(result(two_boxes(), name))
    assert sink.summary() == f"3 KITTI text files in {tmp_path} (1 older text files are beside them)"
    held = [value for value in vars(sink).values() if isinstance(value, set | list | dict)]
    assert held == [{tmp_path / "000001.txt"}]  # what lay there before, not a path for each frame


def test_places(tmp_path: Path) -> None:
    assert claim_folder(tmp_path / "a" / "b", overwrite=False).is_dir()
    assert claim_folder(tmp_path / "a" / "b", overwrite=False).is_dir()  # an empty folder is nobody's
    file = claim_file(tmp_path / "c" / "d.txt", overwrite=False)
    assert file.parent.is_dir()
    assert not file.exists()
    file.write_text("mine", encoding="utf-8")
    for claim in (claim_file, claim_folder):
        with pytest.raises(OutputError):
            claim(file, overwrite=False)
    with pytest.raises(OutputError, match="not empty"):
        claim_folder(tmp_path / "c", overwrite=False)
    with pytest.raises(OutputError, match="is a folder"):
        claim_file(tmp_path / "c", overwrite=True)
    assert claim_folder(tmp_path / "c", overwrite=True).is_dir()
    assert claim_file(file, overwrite=True).read_text(encoding="utf-8") == "mine"
