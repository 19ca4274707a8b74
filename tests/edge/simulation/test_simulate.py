"""Data sets on disk: layouts, same seed same bytes, going on, refusals, rigs."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from edge.cli.main import app
from edge.simulation.dataset import ObjectFolder
from edge.simulation.drafts import Mix
from edge.simulation.render.renderer import Renderer
from edge.simulation.rig import cameras, kitti_rig, load_rig, oak_d_rig
from edge.simulation.simulate import simulate
from runtime.contracts.errors import FormatError, MissingExtraError, OutputError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_calib, parse_labels, parse_tracking_labels
from runtime.rig import format_geometry

SIZE_WH = (310, 94)  # a quarter of KITTI's picture: the same world, quickly drawn


@pytest.fixture(scope="module")
def small_rig(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("rig") / "small.json"
    path.write_text(format_geometry(kitti_rig().scale((0.25, 0.25), SIZE_WH)))
    return str(path)


@pytest.fixture(scope="module")
def egl() -> None:
    try:
        Renderer(SIZE_WH).close()
    except MissingExtraError as error:
        pytest.skip(str(error))


def _bytes(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}


def test_kitti_rig_is_kittis() -> None:
    rig = kitti_rig()
    assert rig.image_size_wh == (1242, 375)
    assert rig.focal_px == pytest.approx(721.5377)
    assert rig.baseline_m == pytest.approx(0.5327, abs=1e-4)


@pytest.mark.parametrize("rig", [kitti_rig(), oak_d_rig()])
def test_cameras_project_like_the_rig(rig: StereoGeometry) -> None:
    point = np.array([1.2, 0.7, 9.0])
    for camera, projection in zip(cameras(rig, np.eye(4)), (rig.P2, rig.P3), strict=True):
        local = camera.camera_from_world[:3, :3] @ point + camera.camera_from_world[:3, 3]
        pixel = camera.intrinsics @ local
        expected = projection @ np.append(point, 1.0)
        assert pixel[:2] / pixel[2] == pytest.approx(expected[:2] / expected[2])


def test_rig_files_come_back(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text(format_geometry(oak_d_rig()))
    assert np.array_equal(load_rig(str(path)).P3, oak_d_rig().P3)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"schema": 9}, "schema"), ({"P2": [[1, 2], [3, 4]]}, "P2"), ({"image_size_wh": 7}, "image_size_wh"),
        ({"P3": oak_d_rig().P2.tolist()}, "baseline"), ({"P2": None}, "P2"),
    ],
)  # fmt: skip
def test_broken_rig_files_are_refused(tmp_path: Path, change: dict[str, object], word: str) -> None:
    record = json.loads(format_geometry(oak_d_rig()))
    path = tmp_path / "rig.json"
    path.write_text(json.dumps({**record, **change}))
    with pytest.raises(FormatError, match=word):
        load_rig(str(path))


def test_rig_file_without_an_entry_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rig.json"
    path.write_text('{"schema": 1}')
    with pytest.raises(FormatError, match="image_size_wh"):
        load_rig(str(path))
    with pytest.raises(FormatError, match="no file"):
        load_rig("kity")


@pytest.mark.parametrize(
    "settings",
    [
        {"mix": Mix(people=0.0)},
        {"mix": Mix(near=21.0)},
        {"mix": Mix(people=2.0), "sequence": True},
        {"frames": 0},
        {"workers": 0},
        {"image_format": "bmp"},
        {"sequence": True, "seconds": 0.0},
        {"seed": -3},
    ],
)
def test_senseless_settings_are_refused_and_make_no_folder(tmp_path: Path, settings: dict[str, object]) -> None:
    with pytest.raises(FormatError):
        simulate(tmp_path / "out", **settings)  # type: ignore[arg-type]
    assert not (tmp_path / "out").exists()


def test_foreign_folders_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="not empty"):
        simulate(tmp_path, frames=1)
    assert _bytes(tmp_path) == {"mine.txt": b"mine"}
    with pytest.raises(OutputError, match="is a file"):
        simulate(tmp_path / "mine.txt", frames=1)


@pytest.fixture(scope="module")
def frames_folder(tmp_path_factory: pytest.TempPathFactory, small_rig: str, egl: None) -> Path:
    out = tmp_path_factory.mktemp("frames") / "set"
    assert simulate(out, frames=3, seed=50_000, rig=small_rig, workers=1) == 3
    return out


def test_object_layout(frames_folder: Path) -> None:
    training = frames_folder / "training"
    for name in ("000000", "000001", "000002"):
        left, right = (cv2.imread(str(training / folder / f"{name}.jpg")) for folder in ("image_2", "image_3"))
        assert left.shape == right.shape == (SIZE_WH[1], SIZE_WH[0], 3)
        assert np.abs(left.astype(int) - right).mean() > 1.0, "the views differ"
        geometry = parse_calib((training / "calib" / f"{name}.txt").read_text(), SIZE_WH)
        assert geometry.baseline_m == pytest.approx(kitti_rig().baseline_m)
        labels = parse_labels((training / "label_2" / f"{name}.txt").read_text())
        assert (labels.box_in_left_image[:, 2] <= SIZE_WH[0]).all()
    for split in ("all", "train", "val"):
        assert (frames_folder / "ImageSets" / f"{split}.txt").read_text().split() == ["000000", "000001", "000002"]
    assert json.loads((frames_folder / "rig.json").read_text())["image_size_wh"] == list(SIZE_WH)


def test_same_seed_same_bytes_with_any_number_of_workers(frames_folder: Path, small_rig: str, tmp_path: Path) -> None:
    simulate(tmp_path / "again", frames=3, seed=50_000, rig=small_rig, workers=2)
    assert _bytes(tmp_path / "again") == _bytes(frames_folder)


def test_a_frame_depends_on_its_own_seed_alone(frames_folder: Path, small_rig: str, tmp_path: Path) -> None:
    simulate(tmp_path / "one", frames=1, seed=50_002, rig=small_rig, workers=1)
    one, three = tmp_path / "one" / "training", frames_folder / "training"
    assert (one / "image_3" / "000000.jpg").read_bytes() == (three / "image_3" / "000002.jpg").read_bytes()
    assert (one / "label_2" / "000000.txt").read_text() == (three / "label_2" / "000002.txt").read_text()


def test_an_interrupted_set_is_completed_and_other_settings_are_refused(
    small_rig: str, egl: None, tmp_path: Path
) -> None:
    out = tmp_path / "set"
    simulate(out, frames=1, seed=50_000, rig=small_rig, workers=1)
    written = (out / "training" / "image_2" / "000000.jpg").stat().st_mtime_ns
    seen: list[tuple[int, int]] = []
    simulate(
        out, frames=2, seed=50_000, rig=small_rig, workers=1, progress=lambda done, total: seen.append((done, total))
    )
    assert seen == [(1, 2), (2, 2)]
    assert (out / "training" / "image_2" / "000000.jpg").stat().st_mtime_ns == written
    with pytest.raises(OutputError, match="other settings"):
        simulate(out, frames=2, seed=60_000, rig=small_rig, workers=1)


def test_a_smaller_count_does_not_shorten_the_lists_of_a_set(tmp_path: Path, small_rig: str) -> None:
    out, lists = tmp_path / "set", tmp_path / "set" / "ImageSets"
    geometry = load_rig(small_rig)
    folder = ObjectFolder(out, "jpg", 92)
    assert folder.prepare(geometry, 4) == 4  # the fourth frame is never drawn here
    for index in range(3):
        (out / "training" / "label_2" / f"{index:06d}.txt").write_text("")
    assert folder.prepare(geometry, 2) == 3
    for split in ("all", "train", "val"):
        assert (lists / f"{split}.txt").read_text().split() == ["000000", "000001", "000002"]
    (lists / "train.txt").write_text("000001\n")  # a user's choice
    assert folder.prepare(geometry, 3) == 3
    assert (lists / "train.txt").read_text() == "000001\n"
    assert folder.prepare(geometry, 5) == 5
    assert len((lists / "train.txt").read_text().split()) == 5


def test_the_command_says_that_a_set_has_more_frames(tmp_path: Path, small_rig: str, frames_folder: Path) -> None:
    out = tmp_path / "set"
    shutil.copytree(frames_folder, out)
    words = ["simulate", str(out), "--rig", small_rig, "--seed", "50000", "--frames", "2"]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, result.output
    assert f"3 labelled pairs in {out}, more than --frames 2" in result.stderr
    assert (out / "ImageSets" / "train.txt").read_text().split() == ["000000", "000001", "000002"]


def test_tracking_layout(small_rig: str, egl: None, tmp_path: Path) -> None:
    out = tmp_path / "drive"
    assert simulate(out, sequence=True, seconds=0.3, seed=50_010, rig=small_rig, image_format="png", workers=2) == 3
    training = out / "training"
    for folder in ("image_02", "image_03"):
        assert sorted(path.name for path in (training / folder / "0000").iterdir()) == [
            f"{k:06d}.png" for k in range(3)
        ]
    by_frame = parse_tracking_labels((training / "label_02" / "0000.txt").read_text())
    assert sorted(by_frame) == [0, 1, 2]
    sizes: dict[int, list[float]] = {}
    for labels in by_frame.values():
        assert len(set(labels.track_id.tolist())) == len(labels)
        for row in range(len(labels)):
            assert (
                sizes.setdefault(int(labels.track_id[row]), labels.size_hwl[row].tolist())
                == labels.size_hwl[row].tolist()
            )
    assert sizes
    parse_calib((training / "calib" / "0000.txt").read_text(), SIZE_WH)
