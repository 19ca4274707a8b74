"""``edge evaluate``: the table, the JSON, and exit codes, through the real command line."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from edge.cli.main import app

LINE = "Car 0.00 0 {alpha} 600.00 150.00 720.00 220.00 1.50 1.60 3.90 0.00 1.60 20.00 0.30"
HEAVY = ("torch", "onnx", "shapely", "matplotlib", "depthai", "moderngl")


def run(*arguments: object) -> int:
    from typer.main import get_command

    with pytest.raises(SystemExit) as ended:
        get_command(app).main([str(item) for item in arguments])
    return int(ended.value.code or 0)


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    labels, detections = tmp_path / "labels", tmp_path / "found"
    labels.mkdir()
    detections.mkdir()
    for index in range(3):
        (labels / f"{index:06d}.txt").write_text(LINE.format(alpha=0.1) + "\n")
        (detections / f"{index:06d}.txt").write_text(LINE.format(alpha=0.1) + f" 0.{index + 5}\n")
    return labels, detections


def test_empty_files_are_empty_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for name in ("labels", "found"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "000000.txt").write_text("")
    assert run("evaluate", "--labels", tmp_path / "labels", "--detections", tmp_path / "found") == 0
    assert "Car 0 / 0 / 0" in capsys.readouterr().out


def test_table_and_json(folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    target = tmp_path / "new" / "ap.json"
    assert run("evaluate", "--labels", folders[0], "--detections", folders[1], "--json", target) == 0
    tree = json.loads(target.read_text())
    assert list(tree) == ["Car", "Pedestrian", "Cyclist"]
    assert tree["Car"]["aos"]["0.7"] == tree["Car"]["2d"]["0.7"]
    # three objects reach recall points 0 to 2 of 40: R40 counts points 1 and 2, R11 point 0
    assert tree["Car"]["3d"]["0.5"] == {"R40": [5.0] * 3, "R11": [pytest.approx(100 / 11)] * 3}
    out = capsys.readouterr().out
    assert "Car 3 / 3 / 3" in out
    assert "3 frames, 3 detections" in out


def test_aos_is_left_out_without_observation_angle(folders: tuple[Path, Path], tmp_path: Path):
    (folders[1] / "000001.txt").write_text(LINE.format(alpha=-10) + " 0.5\n")
    target = tmp_path / "ap.json"
    assert run("evaluate", "--labels", folders[0], "--detections", folders[1], "--json", target) == 0
    tree = json.loads(target.read_text())
    assert "aos" not in tree["Car"]
    assert "aos" in tree["Cyclist"]


@pytest.mark.parametrize("missing", ["labels", "found"])
def test_missing_file_of_the_split(
    folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], missing: str
):
    split = tmp_path / "val.txt"
    split.write_text("000000\n000001\n")
    (tmp_path / missing / "000001.txt").unlink()
    assert run("evaluate", "--labels", folders[0], "--detections", folders[1], "--split", split) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "000001.txt is missing" in captured.err


@pytest.mark.parametrize("option", ["--labels", "--detections", "--split"])
def test_wrong_paths(folders: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str):
    arguments = {"--labels": folders[0], "--detections": folders[1], option: tmp_path / "nowhere"}
    assert run("evaluate", *(item for pair in arguments.items() for item in pair)) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_imports_nothing_heavy(folders: tuple[Path, Path]):
    code = (
        "import sys; sys.argv = ['edge', *sys.argv[1:]]\n"
        "from edge.cli.main import main\n"
        "try:\n    main()\n"
        f"finally:\n    assert not [name for name in {HEAVY!r} if name in sys.modules], 'heavy import'\n"
    )
    words = ["evaluate", "--labels", str(folders[0]), "--detections", str(folders[1])]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert "KITTI AP" in done.stdout
