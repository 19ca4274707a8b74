"""Results for the test server, read back; labels as detections of themselves."""

from __future__ import annotations

import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge.evaluation.kitti_ap import evaluate
from edge.evaluation.submission import ARCHIVE, DATA_FOLDER, write_submission
from edge.evaluation.text_folders import read_text_frames
from edge.samples import measuring_source
from runtime.contracts.errors import SourceError
from runtime.contracts.kitti import parse_detections, parse_labels
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.sources.factory import open_sequence

PERFECT_TOLERANCE = 1e-9  # per cent: a mean of forty ones


def as_detections(labels: Objects3D) -> Detections3D:
    return Detections3D(
        class_id=labels.class_id,
        score=np.ones(len(labels)),
        box_in_left_image=labels.box_in_left_image,
        center_in_camera=labels.center_in_camera,
        size_hwl=labels.size_hwl,
        alpha_rad=labels.alpha_rad,
        yaw_rad=labels.yaw_rad,
        class_names=labels.class_names,
    )


def some_detections() -> Detections3D:
    return parse_detections("Car -1 -1 0.5 10 20 30 40 1.5 1.6 3.9 1 1.6 20 0.55 0.9\n")


def test_no_frames_make_an_empty_archive(tmp_path: Path) -> None:
    with zipfile.ZipFile(write_submission(tmp_path, [], [])) as members:
        assert members.namelist() == []


def test_frames_without_detections_have_empty_files(tmp_path: Path) -> None:
    nothing = parse_detections("")
    archive = write_submission(tmp_path, ["000007", "000000", "007517"], [some_detections(), nothing, nothing])
    assert archive == tmp_path / ARCHIVE
    with zipfile.ZipFile(archive) as members:
        assert members.testzip() is None
        assert members.namelist() == ["000000.txt", "000007.txt", "007517.txt"]  # at the root
        assert members.read("000000.txt") == members.read("007517.txt") == b""
        back = parse_detections(members.read("000007.txt").decode())
        for name in members.namelist():
            assert (tmp_path / DATA_FOLDER / name).read_bytes() == members.read(name)
    assert len(back) == 1 and back.score[0] == pytest.approx(0.9)


def test_the_same_results_give_the_same_bytes(tmp_path: Path) -> None:
    archives = []
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        archives.append(write_submission(tmp_path / name, ["000001"], [some_detections()]).read_bytes())
    assert archives[0] == archives[1]


@pytest.mark.parametrize("names", [["0010/000003"], ["3"], ["000001", "000001"]])
def test_frames_that_the_server_does_not_know(tmp_path: Path, names: list[str]) -> None:
    with pytest.raises(SourceError, match="test server: found"):
        write_submission(tmp_path, names, [some_detections()] * len(names))
    assert list(tmp_path.iterdir()) == []


def test_simulated_labels_against_themselves(tmp_path: Path) -> None:
    with open_sequence(measuring_source()) as frames:
        labels = [found for found in map(frames.labels, range(len(frames))) if found is not None]
    tree = evaluate(labels, [as_detections(item) for item in labels]).ap()["Car"]
    assert tree.keys() == {"2d", "bev", "3d", "aos"}
    for metric in tree.values():
        for points in metric.values():
            assert points["R40"] == pytest.approx([100.0] * 3, abs=PERFECT_TOLERANCE)
            assert points["R11"] == pytest.approx([100.0] * 3, abs=PERFECT_TOLERANCE)


@pytest.mark.slow
def test_real_labels_against_themselves(kitti_dir: Path, tmp_path: Path) -> None:
    with tarfile.open(kitti_dir / "labels_and_splits.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    names = (tmp_path / "ImageSets" / "val.txt").read_text().split()
    labels = [parse_labels((tmp_path / "label_2" / f"{name}.txt").read_text()) for name in names]
    out = tmp_path / "results"
    out.mkdir()
    write_submission(out, names, [as_detections(item) for item in labels])
    frames = read_text_frames(tmp_path / "label_2", out / DATA_FOLDER, tmp_path / "ImageSets" / "val.txt")
    assert len(frames.frame_ids) == 3769
    tree = evaluate(frames.labels, frames.detections).ap()
    for name in ("Car", "Pedestrian", "Cyclist"):
        for metric, of_overlap in tree[name].items():
            for points in of_overlap.values():
                assert points["R40"] == pytest.approx([100.0] * 3, abs=PERFECT_TOLERANCE), (name, metric)


def test_command_writes_results(toy_model: Callable[..., Path], toy_recording: Path, tmp_path: Path) -> None:
    from typer.main import get_command

    from edge.cli.main import app

    out = tmp_path / "results"
    command = ["accuracy", str(toy_model("fp32")), "--source", f"kitti-object:{toy_recording}?split=val"]
    with pytest.raises(SystemExit) as ended:
        get_command(app).main([*command, "--results", str(out)])
    assert ended.value.code in (0, None)
    with zipfile.ZipFile(out / ARCHIVE) as members:
        assert members.namelist() == [f"{number:06d}.txt" for number in range(6)]
        assert len(parse_detections(members.read("000000.txt").decode())) == 3
