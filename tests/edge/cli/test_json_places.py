"""``--json`` of the measuring commands: a user's file is never replaced unasked, and a bad place is said at once."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edge.cli.main import app

WORK = {
    "accuracy": "edge.evaluation.run.run_model",
    "bench": "runtime.bench.bench_models",
    "evaluate": "edge.evaluation.kitti_ap.evaluate",
}


@pytest.fixture(params=list(WORK))
def command(request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    """A command line that ends well, but for ``--json``."""
    if request.param == "evaluate":
        folder = tmp_path / "texts"
        folder.mkdir()
        (folder / "000000.txt").write_text("")
        return ["evaluate", "--labels", str(folder), "--detections", str(folder)]
    model, drive = request.getfixturevalue("tiny_model"), request.getfixturevalue("tiny_drive")
    few = ["--frames", "1", "--repeat", "1"] if request.param == "bench" else []
    return [request.param, str(model), "--source", f"kitti-object:{drive}?limit=1", *few]


@pytest.mark.parametrize(
    ("place", "words"),
    [
        ("taken.json", ("exists", "--overwrite")),
        ("full", ("is a folder",)),
        ("taken.json/figures.json", ("cannot be made",)),
    ],
)
def test_a_bad_place_is_said_before_the_work(
    command: list[str], place: str, words: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "taken.json").write_text("mine")
    monkeypatch.setattr(WORK[command[0]], lambda *_, **__: pytest.fail("worked before it looked at the place"))
    result = CliRunner().invoke(app, [*command, "--json", str(tmp_path / place)])
    assert result.exit_code == 2, result.output
    (line,) = result.stderr.splitlines()
    assert all(word in line for word in words), line
    assert (tmp_path / "taken.json").read_text() == "mine"


def test_overwrite_replaces(command: list[str], tmp_path: Path) -> None:
    (tmp_path / "taken.json").write_text("mine")
    result = CliRunner().invoke(app, [*command, "--json", str(tmp_path / "taken.json"), "--overwrite"])
    assert result.exit_code == 0, result.output
    assert json.loads((tmp_path / "taken.json").read_text())
