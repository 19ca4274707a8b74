"""`edge doctor`."""

from __future__ import annotations

import re
import shutil
import sys
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from edge.cli import doctor
from edge.cli.main import app

REPOSITORY = Path(__file__).resolve().parents[3]


def test_it_tells_what_is_here(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_self_check", list)
    result = CliRunner().invoke(app, ["doctor"])
    assert result.exit_code == 0
    for word in ("Python", "onnxruntime", "processor", "native library", "extra", "EGL", "OAK"):
        assert word in result.output


def test_extras_are_those_of_the_project_file() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    known = project["optional-dependencies"]
    for extra, packages in doctor.EXTRAS.items():
        assert sorted(packages) == sorted(re.split("[<>=]", line)[0] for line in known[extra]), extra


def test_a_missing_extra_names_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "_installed", lambda name: name != "moderngl")
    (row,) = [row for row in doctor._extras() if row.subject == "extra simulate"]
    assert row.found == "missing moderngl"
    assert row.remedy == "pip install '.[simulate]'"
    assert row.state is doctor.State.OPTIONAL


@pytest.mark.parametrize("damaged", [False, True])
def test_a_model_is_run(damaged: bool, tiny_model: Path, tiny_drive: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("edge.samples.measuring_source", lambda: f"kitti-object:{tiny_drive}")
    if damaged:
        shutil.copy(tiny_model / "manifest.json", tiny_model / "model.onnx")
    finding = doctor._run_model(tiny_model)
    assert finding.state is (doctor.State.BROKEN if damaged else doctor.State.GOOD)
    assert ("sha256" if damaged else "3 boxes in 3 frames") in finding.found


def test_a_broken_package_is_a_row_of_the_table(tiny_model: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "runtime.detector", None)  # as where OpenCV lacks a library of the system
    finding = doctor._run_model(tiny_model)
    assert finding.state is doctor.State.BROKEN and "runtime.detector" in finding.found


@pytest.mark.parametrize(
    ("code", "found"),
    [("raise ImportError('libusb is missing')", "libusb is missing"), ("import none_such", "found no none_such")],
)
def test_a_broken_depthai_is_a_row_of_the_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: str, found: str
) -> None:
    (tmp_path / "depthai.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "depthai", raising=False)
    monkeypatch.setattr(doctor, "_installed", lambda name: True)
    (row,) = doctor._cameras()
    assert row.state is doctor.State.OPTIONAL and found in row.found
