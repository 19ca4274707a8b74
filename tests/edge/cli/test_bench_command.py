"""``edge bench``: table, JSON, wrong input; and that it needs no workbench package."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from edge.cli.main import app


def run(*arguments: object) -> int:
    from typer.main import get_command

    with pytest.raises(SystemExit) as ended:
        get_command(app).main([str(item) for item in arguments])
    return int(ended.value.code or 0)


def test_two_models_and_their_operators(tiny_model: Path, tiny_drive: Path, tmp_path: Path, capsys) -> None:
    place = tmp_path / "bench.json"
    source = ["--source", f"kitti-object:{tiny_drive}", "--frames", 2, "--repeat", 2]
    assert run("bench", tiny_model, tiny_model, *source, "--profile", "--threads", 1, "--json", place) == 0
    shown = capsys.readouterr().out
    for word in ("preprocess", "inference", "decode", "ratio", "operators as they ran"):
        assert word in shown
    record = json.loads(place.read_text(encoding="utf-8"))
    assert (record["frames"], record["threads"], len(record["models"])) == (2, 1, 2)
    first = record["models"][0]
    assert first["runs"] == 4
    assert first["ratio"] == 1.0
    assert first["stages"]["total"]["median"] > 0
    assert {"operator", "nodes", "ms", "multiply_adds"} == set(first["operators"][0])


@pytest.mark.parametrize(
    ("extra", "said"), [(["--source", "kitti-object:nowhere"], "nowhere"), (["--repeat", "0"], "repeat")]
)
def test_wrong_input_is_one_line(tiny_model: Path, extra, said, capsys) -> None:
    assert run("bench", tiny_model, *extra) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert said in lines[0]


def test_a_folder_without_a_manifest_is_said_before_frames_are_read(tmp_path: Path, capsys) -> None:
    assert run("bench", tmp_path, "--source", "kitti-object:nowhere") == 2
    assert "manifest" in capsys.readouterr().err


def test_it_imports_nothing_of_the_workbench(tiny_model: Path, tiny_drive: Path) -> None:
    code = (
        "import sys\n"
        "for name in ('torch', 'onnx', 'matplotlib', 'shapely', 'depthai'): sys.modules[name] = None\n"
        "from edge.cli.main import main\n"
        f"sys.argv = ['edge', 'bench', {str(tiny_model)!r}, '--source', 'kitti-object:{tiny_drive}',"
        " '--frames', '1', '--repeat', '1', '--profile']\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
