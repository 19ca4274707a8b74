"""Wrong input gets exit code 2 and exactly one line on stderr, whatever the libraries below would have printed."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from edge.cli.main import app
from runtime.contracts.manifest import file_sha256

NO_CAMERA_LIMIT_SECS = 2.0
"""What a user may wait to hear that no camera is there."""


def complaint(capfd: pytest.CaptureFixture[str], *words: str | Path, code: int = 2) -> str:
    """Runs a command that must fail; returns its one line, stderr of C libraries included."""
    capfd.readouterr()
    result = CliRunner().invoke(app, [str(word) for word in words])
    lines = (result.stderr + capfd.readouterr().err).splitlines()
    assert result.exit_code == code, (result.exit_code, lines, result.exception)
    assert len(lines) == 1, lines
    assert lines[0].startswith("error: ")
    assert "Traceback" not in lines[0]
    return lines[0]


def drop_right(drive: Path) -> None:
    (drive / "training" / "image_3" / "000001.png").unlink()


def shrink_right(drive: Path) -> None:
    cv2.imwrite(str(drive / "training" / "image_3" / "000001.png"), np.zeros((60, 128, 3), np.uint8))


def cut_png(drive: Path) -> None:
    path = drive / "training" / "image_2" / "000001.png"
    path.write_bytes(path.read_bytes()[:-30])


def flip_png_byte(drive: Path) -> None:
    path = drive / "training" / "image_2" / "000001.png"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(bytes(content))


def no_png_at_all(drive: Path) -> None:
    (drive / "training" / "image_2" / "000001.png").write_text("not an image", encoding="utf-8")


def calibration_without_p2(drive: Path) -> None:
    path = drive / "training" / "calib" / "000001.txt"
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    path.write_text("".join(line for line in lines if not line.startswith("P2")), encoding="utf-8")


def no_calibration(drive: Path) -> None:
    (drive / "training" / "calib" / "000001.txt").unlink()


def other_image_size(drive: Path) -> None:
    for folder in ("image_2", "image_3"):
        cv2.imwrite(str(drive / "training" / folder / "000001.png"), np.zeros((1, 1), np.uint8))


def far_rig(drive: Path) -> None:
    for path in (drive / "training" / "calib").iterdir():
        text = path.read_text(encoding="utf-8")
        path.write_text(text.replace("-1.000000000000e+02", "-2.000000000000e+02"), encoding="utf-8")


def empty_folder(drive: Path) -> None:
    for path in (drive / "training" / "image_2").iterdir():
        path.unlink()


def broken_label(drive: Path) -> None:
    (drive / "training" / "label_2" / "000001.txt").write_text("Car 0 0\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (drop_right, ("000001", "no right image")),
        (shrink_right, ("000001", "128x64", "128x60")),
        (cut_png, ("000001", "cut short")),
        (flip_png_byte, ("000001", "broken")),
        (no_png_at_all, ("000001", "none of PNG, JPEG, WebP")),
        (calibration_without_p2, ("000001", "no P2")),
        (no_calibration, ("000001.txt", "cannot be read")),
        (far_rig, ("baseline", "--allow-other-rig")),
        (empty_folder, ("image_2", "holds no image")),
    ],
)
def test_a_damaged_drive(
    damage: Callable[[Path], None],
    words: tuple[str, ...],
    tiny_model: Path,
    tiny_drive: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    damage(tiny_drive)
    line = complaint(capfd, "stream", tiny_model, "--source", f"kitti-object:{tiny_drive}")
    for word in words:
        assert word in line


def test_a_broken_label_when_labels_are_asked_for(
    tiny_model: Path, tiny_drive: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    broken_label(tiny_drive)
    words = ("stream", tiny_model, "--source", f"kitti-object:{tiny_drive}", "--labels")
    assert "000001.txt" in complaint(capfd, *words, "--pictures", tmp_path / "pictures")
    assert "expected --video or --pictures" in complaint(capfd, *words)


@pytest.mark.parametrize(
    ("uri", "words"),
    [
        ("", ("no scheme", "SCHEME:TARGET")),
        ("nonsense", ("no scheme", "kitti-object:")),
        ("webcam:0", ("unknown scheme", "kitti-tracking", "oak")),
        ("kitti-object:", ("names nothing", "kitti-object:ROOT")),
        ("kitti-object:{drive}?splitt=val", ("unknown option", "split", "limit")),
        ("kitti-object:{drive}?split=", ("split=", "name=value")),
        ("kitti-object:{drive}?split=val&split=val", ("given twice",)),
        ("kitti-object:{drive}?split=train", ("no split 'train'", "val")),
        ("kitti-object:{drive}?limit=many", ("limit=many", "whole number")),
        ("kitti-object:{drive}?step=0", ("step=0", "1 or more")),
        ("kitti-object:{drive}?start=9", ("start=9", "none of 4 frames")),
        ("kitti-object:{drive}?rate=-1", ("rate=-1", "above 0")),
        ("kitti-object:{drive}?views=right", ("views=right", "left or both")),
        ("kitti-object:{drive}/training", ("no folder", "image_2")),
        ("kitti-tracking:{drive}", ("no folder", "image_02")),
        ("kitti-raw:{drive}/2011_09_26_drive_0001_sync", ("no folder", "image_02")),
        ("kitti-odometry:{drive}", ("no folder", "sequences")),
        ("images:{drive}/training/image_2/*.png,{drive}/training/image_3/*.png", ("no geometry", "geometry=FILE")),
        ("images:{drive}/a/*.png,{drive}/b/*.png?geometry={drive}/training/calib/000000.txt", ("finds no image",)),
        ("images:{drive}?geometry={drive}/training/calib/000000.txt", ("LEFT_GLOB,RIGHT_GLOB",)),
        ("video:{drive}/a.mp4,{drive}/b.mp4?geometry={drive}/training/calib/000000.txt", ("no file", "a.mp4")),
        (
            "video:{drive}/ImageSets/val.txt?layout=side-by-side&geometry={drive}/training/calib/000000.txt",
            ("no video",),
        ),
        ("video:{drive}/a.mp4?layout=top&geometry={drive}/training/calib/000000.txt", ("layout=top", "side-by-side")),
        ("oak:?size=big", ("size=big", "1280x400")),
    ],
)
def test_a_wrong_source(
    uri: str, words: tuple[str, ...], tiny_model: Path, tiny_drive: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    line = complaint(capfd, "stream", tiny_model, "--source", uri.format(drive=tiny_drive))
    for word in words:
        assert word in line


def test_one_view_for_a_stereo_model(tiny_model: Path, tiny_drive: Path, capfd: pytest.CaptureFixture[str]) -> None:
    line = complaint(capfd, "stream", tiny_model, "--source", f"kitti-object:{tiny_drive}?views=left")
    assert "no right image" in line


def change_model(model: Path) -> None:
    path = model / "model.onnx"
    path.write_bytes(path.read_bytes() + b"\0")


def truncate_model(model: Path) -> None:
    """A file cut short whose hash the manifest confirms: the download that went wrong before the manifest was made."""
    path = model / "model.onnx"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    edit_manifest(model, lambda data: data["sha256"].update({"model.onnx": file_sha256(path)}))


def edit_manifest(model: Path, change: Callable[[dict], object]) -> None:
    path = model / "manifest.json"
    data = json.loads(path.read_text(encoding="utf-8"))
    change(data)
    path.write_text(json.dumps(data), encoding="utf-8")


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (change_model, ("model.onnx", "sha256")),
        (truncate_model, ("model.onnx", "truncated")),
        (lambda model: (model / "priors.npz").unlink(), ("priors.npz",)),
        (lambda model: (model / "manifest.json").unlink(), ("manifest.json",)),
        (lambda model: (model / "manifest.json").write_text("{", encoding="utf-8"), ("no JSON",)),
        (lambda model: edit_manifest(model, lambda data: data.update(schema_version=2)), ("schema version 2",)),
        (lambda model: edit_manifest(model, lambda data: data.update(colour="red")), ("unknown key", "colour")),
        (lambda model: edit_manifest(model, lambda data: data.update(input_size_hw=[32, 32])), ("left", "32, 64")),
        (lambda model: edit_manifest(model, lambda data: data.update(classes=["Car", "Pedestrian"])), ("export",)),
    ],
)
def test_a_damaged_model_directory(
    damage: Callable[[Path], None],
    words: tuple[str, ...],
    tiny_model: Path,
    tiny_drive: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    damage(tiny_model)
    line = complaint(capfd, "stream", tiny_model, "--source", f"kitti-object:{tiny_drive}")
    for word in words:
        assert word in line


def test_a_folder_that_is_no_model(tiny_drive: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert "model directory" in complaint(capfd, "stream", tiny_drive, "--source", f"kitti-object:{tiny_drive}")


@pytest.mark.parametrize(
    ("flag", "name", "words"),
    [
        ("--json", "taken.txt", ("exists", "--overwrite")),
        ("--json", "full", ("is a folder",)),
        ("--kitti", "full", ("not empty", "--overwrite")),
        ("--kitti", "taken.txt", ("is a file",)),
        ("--pictures", "full", ("not empty", "--overwrite")),
        ("--video", "taken.mp4", ("exists", "--overwrite")),
        ("--video", "run.gif", (".gif", ".mp4")),
        ("--video", "taken.txt/run.mp4", ("cannot be made",)),
    ],
)
def test_nothing_is_replaced_unasked(
    flag: str,
    name: str,
    words: tuple[str, ...],
    tiny_model: Path,
    tiny_drive: Path,
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "full").mkdir()
    for taken in ("taken.txt", "taken.mp4", "full/mine.txt"):
        (tmp_path / taken).write_text("mine", encoding="utf-8")
    line = complaint(capfd, "stream", tiny_model, "--source", f"kitti-object:{tiny_drive}", flag, tmp_path / name)
    for word in words:
        assert word in line
    assert (tmp_path / "full" / "mine.txt").read_text(encoding="utf-8") == "mine"
    assert (tmp_path / "taken.txt").read_text(encoding="utf-8") == "mine"


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ((), "no command"),
        (("fly",), "No such command"),
        (("--loud",), "No such option"),
        (("stream",), "Missing"),
        (("stream", "somewhere"), "--source"),
        (("stream", "somewhere", "--source", "oak:", "--speed"), "No such option"),
        (("stream", "somewhere", "--source", "oak:", "--score", "7"), "--score"),
    ],
)
def test_wrong_usage(words: tuple[str, ...], part: str, capfd: pytest.CaptureFixture[str]) -> None:
    line = complaint(capfd, *words)
    assert part in line
    assert "--help" in line


def test_no_camera_is_said_at_once(tiny_model: Path, capfd: pytest.CaptureFixture[str]) -> None:
    depthai = pytest.importorskip("depthai")
    if depthai.Device.getAllAvailableDevices():
        pytest.skip("a camera is connected")
    elapsed_secs = []
    for _ in range(3):  # a busy machine may miss it once
        began = time.monotonic()
        assert "no OAK camera" in complaint(capfd, "stream", tiny_model, "--source", "oak:")
        elapsed_secs.append(time.monotonic() - began)
    assert min(elapsed_secs) < NO_CAMERA_LIMIT_SECS


def test_a_missing_extra_names_the_line_to_install_it(
    tiny_model: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "depthai", None)
    line = complaint(capfd, "stream", tiny_model, "--source", "oak:")
    assert "pip install '.[oak]'" in line


def test_labels_of_a_camera(
    tiny_model: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Camera:
        is_live = True
        frame_hz = 10.0

    monkeypatch.setattr("runtime.sources.factory.open_source", lambda uri: Camera())
    assert "no labels" in complaint(capfd, "stream", tiny_model, "--source", "oak:", "--labels")
