"""What the pages promise: commands and flags that exist, links that lead somewhere, cheap commands that run."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from edge.cli.main import COMMANDS, app
from runtime.sources.factory import KINDS
from runtime.sources.uri import COMMON_OPTIONS, parse_uri

REPOSITORY = Path(__file__).resolve().parents[1]
README = (REPOSITORY / "README.md").read_text(encoding="utf-8")
PAGES = sorted([*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("*.md")])
TARGETS = [
    "help",
    "setup",
    "demo",
    "test",
    "lint",
    "export",
    "quantize",
    "accuracy",
    "stream",
    "bench",
    "train",
    "clean",
]
VARIABLES = ["PRESET", "CHECKPOINT", "KITTI", "SOURCE", "MODEL", "OUT"]
INHERITED = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "MAKEOVERRIDES", "PRIORS", "PYTHON")
MAKE_SECONDS, DOCTOR_SECONDS = 30, 120


def shell_lines(text: str) -> list[str]:
    """Commands of the ``sh`` blocks of a page, comments cut off."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    lines = [line.partition("  #")[0].strip() for block in blocks for line in block.splitlines()]
    return [part.strip() for line in lines if line for part in line.split("&&")]


LINES = shell_lines(README)
EDGE_LINES = [line for line in LINES if line.startswith("edge ")]
MAKE_LINES = [line for line in LINES if line.startswith("make ")]


def test_shell_lines_of_nothing_and_of_a_block() -> None:
    assert shell_lines("") == []
    assert shell_lines("```sh\nmake x && a b   # why\n\nc\n```\n```python\nd\n```\n") == ["make x", "a b", "c"]


def test_the_readme_shows_both_kinds_of_commands() -> None:
    assert {line.split()[1] for line in MAKE_LINES} >= {"demo", "test"}
    assert len(EDGE_LINES) >= len(COMMANDS) - 2  # priors has its place in training, simulate and others are shown


@pytest.mark.parametrize("line", EDGE_LINES)
def test_edge_commands_of_the_readme_parse(line: str) -> None:
    """Every flag exists and every value is of its type, by the command's own parser."""
    name, *arguments = shlex.split(line)[1:]
    group = typer.main.get_command(app)
    command = group.get_command(None, name)  # type: ignore[attr-defined]
    assert command is not None, f"there is no edge {name}"
    command.make_context(name, arguments)


SOURCES = re.findall(r"[`\"]((?:kitti-[a-z]+|images|video|oak):[^`\"]*)[`\"]", README)


@pytest.mark.parametrize("text", SOURCES)
def test_sources_of_the_readme_name_known_kinds_and_options(text: str) -> None:
    parsed = parse_uri(text)
    assert parsed.scheme in KINDS
    assert set(parsed.options) <= {*KINDS[parsed.scheme].options, *COMMON_OPTIONS}
    assert parsed.target or parsed.scheme == "oak"


def test_the_readme_shows_every_kind_of_source() -> None:
    assert {parse_uri(text).scheme for text in SOURCES} == set(KINDS)


@pytest.mark.parametrize("line", MAKE_LINES)
def test_make_commands_of_the_readme_have_their_targets(line: str) -> None:
    words = shlex.split(line)[1:]
    targets = [word for word in words if "=" not in word]
    assert targets
    assert set(targets) <= set(TARGETS)
    ran = make("--dry-run", *words)
    assert ran.returncode == 0, ran.stderr


def make(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    # the make that runs these tests must not pass its own settings on
    environment = {key: value for key, value in os.environ.items() if key not in (*VARIABLES, *INHERITED)}
    return subprocess.run(
        ["make", *arguments],
        cwd=REPOSITORY,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=MAKE_SECONDS,
    )


def test_make_alone_explains_all_targets_and_variables() -> None:
    ran = make()
    assert ran.returncode == 0, ran.stderr
    words = set(re.findall(r"\w+", ran.stdout))
    assert words >= {*TARGETS, *VARIABLES} - {"help"}


@pytest.mark.parametrize("target", TARGETS)
def test_every_target_is_there(target: str) -> None:
    ran = make("--dry-run", target)
    assert ran.returncode == 0, ran.stderr


def test_only_the_default_place_of_results_is_replaced() -> None:
    assert "--overwrite" in make("--dry-run", "demo").stdout
    assert "--overwrite" not in make("--dry-run", "demo", "OUT=mine").stdout


def test_kitti_calibrates_on_its_train_and_measures_on_its_val_frames() -> None:
    planned = make("--dry-run", "quantize", "accuracy", "KITTI=K").stdout
    assert '--calibration "kitti-object:K?split=train"' in planned
    assert '--source "kitti-object:K?split=val"' in planned


def test_training_completes_the_simulated_set_that_is_there(tmp_path: Path) -> None:
    lists = tmp_path / "simulated" / "ImageSets"
    lists.mkdir(parents=True)
    (lists / "train.txt").write_text("000000\n", encoding="utf-8")
    planned = make("--dry-run", "train", f"OUT={tmp_path}", "FRAMES=7").stdout
    assert f"edge simulate {tmp_path}/simulated --frames 7" in planned


def test_a_missing_interpreter_is_one_line() -> None:
    ran = make("PYTHON=no-such-python", "SLIM=no-such-folder", "no-such-folder/ready")
    assert ran.returncode != 0
    errors = [line for line in ran.stderr.splitlines() if line.startswith("error:")]
    assert len(errors) == 1
    assert "no-such-python" in errors[0]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    targets = re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8"))
    local = [target for target in targets if "://" not in target]
    assert [target for target in local if not (page.parent / target).exists()] == []


def test_the_licences_are_named_at_the_top() -> None:
    top = README.partition("\n## ")[0]
    assert "Apache-2.0" in top
    assert "CC BY-NC-SA 3.0" in top
    assert "Apache License" in (REPOSITORY / "LICENSE").read_text(encoding="utf-8")


@pytest.mark.parametrize("arguments", [["--help"], *([name, "--help"] for name in COMMANDS)], ids=" ".join)
def test_help_runs(arguments: list[str]) -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "edge", *arguments],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=DOCTOR_SECONDS,
    )
    assert ran.returncode == 0, ran.stderr
    assert "Usage" in ran.stdout


def test_doctor_runs() -> None:
    ran = subprocess.run(
        [sys.executable, "-m", "edge", "doctor"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=DOCTOR_SECONDS,
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert "native library" in ran.stdout
