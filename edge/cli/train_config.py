"""``edge train --config``: a whole run, stage after stage, from one TOML file.

Keys are the options of ``edge train`` without their dashes, lists for those that may be given again. Tables
``[[stages]]`` hold what a stage has of its own; each goes on from the checkpoint of the one before until its ``steps``.
What is given on the command line goes before what the file says. Paths count from where the command runs.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from runtime.contracts.errors import EdgeError

STAGES_KEY = "stages"
_NOT_IN_FILES = ("config", "resume", "before_cooldown", "help")
_OF_THE_WHOLE_RUN = (
    "preset",
    "method",
    "ablate",
    "freeze_backbone",
    "batch",
    "seed",
    "priors",
    "start",
    "backbone",
    "out",
)
"""What a run keeps from its start, so that no stage may have its own."""


def read_config(context: Any, parameter: Any, file: Path | None) -> Path | None:
    """Callback of ``--config``: what the file says becomes the default of the options.

    Raises:
        EdgeError: the file cannot be read, or names an option that there is not.
    """
    if file is not None:
        common, stages = _options(context.command, file)
        context.default_map = common
        context.meta[STAGES_KEY] = stages
    return file


def stages_to_run(context: Any, out: Path, *, resume: bool) -> list[Any]:
    """A context for each stage that is not done yet, in order; none where the file has no stages.

    Args:
        context: of the command, its options parsed.
        out: the run directory.
        resume: a checkpoint in ``out`` says what is done.

    Raises:
        EdgeError: every stage is done, or the command line gives a length or goes back.
    """
    stages = context.meta.pop(STAGES_KEY, [])
    if not stages:
        return []
    given = {
        option.name: context.params[option.name]
        for option in context.command.params
        if option.name not in _NOT_IN_FILES and _from_command_line(context, option.name)
    }
    if context.params["before_cooldown"]:
        raise EdgeError("found --before-cooldown beside stages, expected a run without them; leave one out")
    if "steps" in given or "epochs" in given:
        raise EdgeError("found --steps or --epochs on the command line, expected none beside stages; change the file")
    done = _steps_done(out) if resume else 0
    to_run = []
    for index, stage in enumerate(stages):
        if stage["steps"] > done:
            options = {**context.default_map, **stage, **given, "resume": resume or index > 0}
            to_run.append(
                context.command.make_context(context.info_name, [], parent=context.parent, default_map=options)
            )
    if not to_run:
        raise EdgeError(f"{out} has done {done} steps, expected less than the last stage's; the run has ended")
    return to_run


def _options(command: Any, file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    try:
        record = tomllib.loads(file.read_text())
    except OSError as error:
        raise EdgeError(f"{file} cannot be read ({error.strerror}), expected a TOML file of a run") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise EdgeError(f"{file} is not TOML ({error}), expected options of `edge train`") from None
    stages = record.pop(STAGES_KEY, [])
    if not isinstance(stages, list) or not all(isinstance(stage, dict) for stage in stages):
        raise EdgeError(f"{file}: {STAGES_KEY} is no list of tables, expected [[{STAGES_KEY}]]")
    known = sorted({option.name for option in command.params} - set(_NOT_IN_FILES))
    tables = [_with_underscores(file, table, known) for table in (record, *stages)]
    for number, stage in enumerate(tables[1:], start=1):
        if not isinstance(stage.get("steps"), int):
            raise EdgeError(f"{file}: stage {number} has no steps, expected the step until which it goes")
        for key in _OF_THE_WHOLE_RUN:
            if key in stage:
                raise EdgeError(
                    f"{file}: stage {number} has its own {key}, which a run keeps from its start; "
                    f"write it above the [[{STAGES_KEY}]]"
                )
    lengths = [stage["steps"] for stage in tables[1:]]
    if lengths != sorted(set(lengths)):
        raise EdgeError(f"{file}: stages end at steps {lengths}, expected each later than the one before")
    return tables[0], tables[1:]


def _with_underscores(file: Path, table: dict[str, Any], known: list[str]) -> dict[str, Any]:
    options = {key.replace("-", "_"): value for key, value in table.items()}
    for key in options:
        if key not in known:
            raise EdgeError(f"{file}: found {key}, expected one of {', '.join(known)}")
    return options


def _from_command_line(context: Any, name: str) -> bool:
    return getattr(context.get_parameter_source(name), "name", "") == "COMMANDLINE"


def _steps_done(out: Path) -> int:
    from edge.training.checkpoint import CHECKPOINT_FILE, load_checkpoint

    return int(load_checkpoint(out / CHECKPOINT_FILE)["step"])
