"""The command line itself: lazy, and one place for errors."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from edge.cli import main
from runtime.contracts.errors import EdgeError, GoalMissedError, SourceError

REPOSITORY = Path(__file__).resolve().parents[3]
HEAVY = ("numpy", "cv2", "onnxruntime", "torch", "onnx", "matplotlib", "moderngl", "depthai")


def run(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=False)


def test_nothing_heavy_is_imported_for_help() -> None:
    code = f"""
import sys
from typer.testing import CliRunner
from edge.cli.main import app, COMMANDS
result = CliRunner().invoke(app, ["--help"])
assert result.exit_code == 0, result.output
heavy = [name for name in {HEAVY!r} if name in sys.modules]
print(heavy)
"""
    result = run(code)
    assert result.stdout.strip() == "[]", result.stdout + result.stderr


def test_help_lists_every_command() -> None:
    output = CliRunner().invoke(main.app, ["--help"]).output
    for name in main.COMMANDS:
        assert name in output


@pytest.mark.parametrize("name", main.COMMANDS)
def test_every_command_has_help(name: str) -> None:
    result = CliRunner().invoke(main.app, [name, "--help"])
    assert result.exit_code == 0
    assert name in result.output


def test_as_a_module() -> None:
    result = subprocess.run(
        [sys.executable, "-m", "edge", "fly"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == "error: No such command 'fly'; see `edge --help`\n"


def wrong_option() -> typer.BadParameter:
    return typer.BadParameter("too big.")


@pytest.mark.parametrize(
    ("error", "line", "code"),
    [
        (SourceError("found a,\nexpected b"), "error: found a, expected b", 2),
        (GoalMissedError("missed"), "error: missed", 1),
        (EdgeError("plain"), "error: plain", 2),
        (KeyboardInterrupt(), "interrupted", 130),
        (typer.Abort(), "interrupted", 130),
        (PermissionError(13, "Permission denied", "x"), "error: [Errno 13] Permission denied: 'x'; check", 2),
        (ZeroDivisionError("by zero"), "error: ZeroDivisionError: by zero; this is a bug", 3),
        (ModuleNotFoundError("no", name="torch.nn"), "error: `edge train` needs torch", 2),
        (ModuleNotFoundError("no", name="somewhere"), "error: ModuleNotFoundError", 3),
        (wrong_option(), "error: Invalid value: too big; see `edge train --help`", 2),
    ],
)
def test_one_line_and_a_code(error: BaseException, line: str, code: int) -> None:
    text, found = main.describe_failure(error, command="train")
    assert text.startswith(line)
    assert "\n" not in text
    assert found == code


@pytest.mark.parametrize(
    ("package", "command", "extra"),
    [
        ("torch", "export", "export"),
        ("onnx", "quantize", "quantize"),
        ("moderngl", "simulate", "simulate"),
        ("depthai", "stream", "oak"),
        ("matplotlib", "accuracy", "report"),
    ],
)
def test_missing_extras_are_in_the_project_file(package: str, command: str, extra: str) -> None:
    import tomllib

    message = str(main.missing_extra(package, command=command))
    assert f"pip install '.[{extra}]'" in message
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert any(line.startswith(package) for line in project["optional-dependencies"][extra])


@pytest.mark.parametrize(
    "words", [["--debug", "stream", "nowhere", "--source", "x:"], ["stream", "nowhere", "--source", "x:", "--debug"]]
)
def test_debug_keeps_the_traceback(words: list[str]) -> None:
    result = CliRunner().invoke(main.app, words)
    assert isinstance(result.exception, EdgeError)


def test_a_closed_pipe_ends_quietly(tiny_model: Path, tiny_drive: Path) -> None:
    """As with ``edge stream ... --json - | head -1``."""
    command = f"{sys.executable} -m edge stream {tiny_model} --source kitti-object:{tiny_drive} --json - | head -c 1"
    words = ["bash", "-o", "pipefail", "-c", command]
    result = subprocess.run(words, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert "rror" not in result.stderr
    assert result.returncode == 141
