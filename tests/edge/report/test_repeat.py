"""The record that makes a report repeatable: a command that parses, hashes, tools, machine; no folders of this one."""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from edge.cli.main import app
from edge.cli.shown_command import shown_command, source_with_geometry
from edge.report.repeat import RepeatRecord, repeat_text
from runtime.machine import Processor

SOURCES = frozenset({"calibration", "validation"})


def context_of(words: list[str]) -> typer.Context:
    """The command line parsed, nothing run."""
    group: Any = typer.main.get_command(app)
    command = group.get_command(None, words[0])
    return command.make_context(words[0], list(words[1:]))


@pytest.mark.parametrize(
    ("words", "shown"),
    [
        (
            ["quantize", "/a/b/fp32", "--out", "/c/int8"],
            "--target x86-vnni --method ",
        ),
        (
            ["quantize", "fp32", "--out", "int8", "--calibration", "kitti-object:/k/object?split=train&limit=5"],
            "--calibration 'kitti-object:object?split=train&limit=5'",
        ),
        (
            ["quantize", "fp32", "--out", "int8", "--calibration", "images:/l/*.png,/r/*.png?geometry=/x/rig.json"],
            "--calibration 'images:*.png,*.png?geometry=rig.json'",
        ),
        (
            ["quantize", "fp32", "--out", "o", "--validation", "kitti-object:/v", "--max-drop", "0.3", "--no-cache"],
            "--validation kitti-object:v --max-drop 0.3 --no-cache",
        ),
        (
            ["quantize", "fp32", "--out", "o", "--target", "arm64", "--method", "entropy"],
            "--target arm64 --method entropy",
        ),
    ],
)
def test_the_shown_command_asks_for_the_same_again(words: list[str], shown: str) -> None:
    found = shown_command(context_of(words), sources=SOURCES, chosen={"target": "x86-vnni"})
    line = shlex.join(found)
    assert shown in line
    assert line.startswith("edge quantize fp32 --out ")
    assert "/" not in line.replace("*.png", "")
    again = context_of(shlex.split(line)[1:])  # parsed by the command line itself
    before = context_of(words)
    for name, value in before.params.items():
        if isinstance(value, Path):
            assert again.params[name] == Path(value.name)
        elif name == "target":
            assert again.params[name] == (value or "x86-vnni")
        elif name not in SOURCES:
            assert again.params[name] == value


def test_other_commands_show_themselves() -> None:
    words = ["accuracy", "/a/one", "/a/two", "--source", "kitti-raw:/d/drive", "--overwrite"]
    found = shown_command(context_of(words), sources=frozenset({"source"}))
    line = shlex.join(found)
    assert line.startswith("edge accuracy one two --source kitti-raw:drive ")
    assert line.endswith(" --overwrite")


def test_a_geometry_file_keeps_its_name_alone() -> None:
    assert source_with_geometry("oak:") == "oak:"
    uri = "video:/a/l.mp4,/a/r.mp4?limit=3&geometry=/a/b/rig.json"
    assert source_with_geometry(uri) == "video:l.mp4,r.mp4?limit=3&geometry=rig.json"


def record(**changes: Any) -> RepeatRecord:
    values = {
        "command": ("edge", "quantize", "my model", "--out", "int8"),
        "sha256": {"float model": "ab12"},
        "recipe": {"name": "static", "weight_bits": 8},
        "settings": {"range method": "mse"},
        "processor": Processor("Some CPU", "x86_64", 2, ("avx2", "avx512_vnni")),
        "native": "vnni",
        "environment": {},
    }
    return RepeatRecord(**{**values, **changes})


def test_text_and_record_hold_what_is_needed() -> None:
    text = repeat_text(record())
    for part in (
        "edge quantize 'my model' --out int8",
        "`ab12`",
        "range method: mse",
        "avx512_vnni",
        "numpy 2",
        "vnni",
    ):
        assert part in text
    assert "environment" not in text
    content = json.loads(json.dumps(record().as_json()))
    assert content["bootstrap"]["seed"] > 0
    assert content["machine"]["flags"] == ["avx2", "avx512_vnni"]
    assert set(content) >= {"command", "sha256", "recipe", "settings", "tools", "native_correlation"}


def test_a_machine_that_tells_nothing_is_said_so() -> None:
    text = repeat_text(record(processor=Processor("arm", "aarch64", 4, None), native=None))
    assert "none told" in text
    assert "function body" in text


def test_switches_of_the_environment_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    from edge.report.repeat import switches

    monkeypatch.setenv("EDGE_NATIVE", "0")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    found = switches()
    assert found["EDGE_NATIVE"] == "0"
    assert "OMP_NUM_THREADS" not in found
    assert "EDGE_NATIVE=0" in repeat_text(record(environment=found))
