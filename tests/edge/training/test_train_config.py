"""A run from one file: options, stages, what the command line may change, and what a wrong file says."""

from __future__ import annotations

import contextlib
import inspect
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.core import TyperCommand

import edge.zoo
from edge.cli.main import LazyGroup
from edge.cli.train import train_command
from edge.cli.train_config import stages_to_run
from runtime.contracts.errors import EdgeError

ZOO = Path(edge.zoo.__file__).parent
RUN = """
preset = "compact"
dataset = ["kitti-object:a", "kitti-object:b"]
repeat = [1, 2]
average-decay = 0.999
[[stages]]
steps = 30
cooldown = 0
[[stages]]
steps = 40
quantize-aware = true
"""


def command() -> TyperCommand:
    found: TyperCommand = LazyGroup(name="edge").get_command(None, "train")
    return found


def parsed(file: Path, *words: str) -> Any:
    return command().make_context("train", ["--config", str(file), "--out", str(file.parent / "run"), *words])


def stages(file: Path, *words: str) -> list[dict[str, Any]]:
    context = parsed(file, *words)
    return [stage.params for stage in stages_to_run(context, context.params["out"], resume=False)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "run.toml"
    path.write_text(RUN)
    return path


def test_stages_share_the_file_and_go_on_from_each_other(file: Path) -> None:
    first, second = stages(file)
    for stage in (first, second):
        assert list(stage["dataset"]) == ["kitti-object:a", "kitti-object:b"]
        assert list(stage["repeat"]) == [1, 2]
        assert stage["average_decay"] == 0.999
        assert stage["out"] == file.parent / "run"
    assert (first["steps"], first["cooldown"], first["quantize_aware"], first["resume"]) == (30, 0, False, False)
    assert (second["steps"], second["cooldown"], second["quantize_aware"], second["resume"]) == (40, 1000, True, True)


def test_the_bundled_models_run_is_such_a_file(file: Path) -> None:
    file.write_text((ZOO / "compact-run.toml").read_text())
    hold, cooldown = stages(file)
    assert hold["preset"] == cooldown["preset"] == "compact"
    assert cooldown["steps"] - hold["steps"] == cooldown["cooldown"]
    assert (hold["quantize_aware"], cooldown["quantize_aware"]) == (False, True)


def test_the_command_line_goes_first(file: Path) -> None:
    for stage in stages(file, "--dataset", "kitti-object:mine", "--seed", "7", "--average-decay", "0.5"):
        assert list(stage["dataset"]) == ["kitti-object:mine"]
        assert (stage["seed"], stage["average_decay"]) == (7, 0.5)


def test_without_stages_the_file_holds_options(file: Path) -> None:
    file.write_text('dataset = ["kitti-object:a"]\nsteps = 5\n')
    context = parsed(file)
    assert list(context.params["dataset"]) == ["kitti-object:a"]
    assert context.params["steps"] == 5
    assert stages_to_run(context, context.params["out"], resume=False) == []


def test_a_resumed_run_skips_what_is_done(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = {"steps": 30}
    monkeypatch.setattr("edge.cli.train_config._steps_done", lambda out: done["steps"])
    out = file.parent / "run"
    left = stages_to_run(parsed(file), out, resume=True)
    assert [(stage.params["steps"], stage.params["resume"]) for stage in left] == [(40, True)]
    done["steps"] = 40
    with pytest.raises(EdgeError, match="the run has ended"):
        stages_to_run(parsed(file), out, resume=True)


@pytest.mark.parametrize(
    "text, wrong",
    [
        ("stepz = 3", "found stepz, expected one of ablate, average_decay"),
        ("resume = true", "found resume"),
        ("steps = ", "is not TOML"),
        ("stages = 3", "no list of tables"),
        ("[[stages]]\ncooldown = 3", "stage 1 has no steps"),
        ("[[stages]]\nsteps = 4\n[[stages]]\nsteps = 4", "each later"),
        ("[[stages]]\nsteps = 4\nfreeze-backbone = 2", r"stage 1 has its own freeze_backbone.* above the \[\[stages"),
        ("before-cooldown = true", "found before_cooldown"),
    ],
)
def test_a_wrong_file_is_told(file: Path, text: str, wrong: str) -> None:
    file.write_text(text)
    with pytest.raises(EdgeError, match=wrong):
        parsed(file)


def test_a_missing_file_and_steps_beside_stages_are_told(file: Path) -> None:
    with pytest.raises(EdgeError, match="cannot be read"):
        parsed(file.with_name("none.toml"))
    with pytest.raises(EdgeError, match=r"--steps .* expected none beside stages"):
        stages(file, "--steps", "3")
    with pytest.raises(EdgeError, match="--before-cooldown beside stages"):
        stages(file, "--before-cooldown")


def test_every_option_may_stand_in_a_file(file: Path) -> None:
    names = set(inspect.signature(train_command).parameters) - {"context", "config", "resume", "before_cooldown"}
    known = {option.name for option in command().params}
    assert names <= known
    for name in names:
        stages = "[[stages]]\nsteps = 3\n"
        file.write_text(stages if name == "steps" else f"{name} = 1\n{stages}")
        with contextlib.suppress(typer.BadParameter.__mro__[2]):  # the required ones are missing here
            parsed(file)
