"""The ``edge`` command: finds each command in its own module and turns errors into one line and an exit code.

A command NAME is the function ``NAME_command`` in ``edge.cli.NAME``. Modules are imported when their command
is asked for (or listed by ``--help``), and import what is heavy inside the function, so that a command needs
only the packages that it uses.
"""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Any

import typer
from typer.core import TyperGroup

from runtime.contracts.errors import EdgeError, MissingExtraError

COMMANDS = (
    "simulate",
    "priors",
    "train",
    "export",
    "confidence",
    "quantize",
    "accuracy",
    "evaluate",
    "stream",
    "bench",
    "doctor",
)
EXTRA_OF_PACKAGE = {
    "depthai": "oak",
    "torch": "train",
    "safetensors": "train",
    "onnx": "quantize",
    "onnxsim": "quantize",
    "onnxscript": "export",
    "moderngl": "simulate",
    "glcontext": "simulate",
    "matplotlib": "report",
}
"""Optional package to the extra that brings it, where the command itself does not decide."""
EXTRA_OF_COMMAND = {"simulate": "simulate", "train": "train", "export": "export", "quantize": "quantize"}
EXIT_WRONG_INPUT = 2
EXIT_BUG = 3
EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141
DEBUG_FLAG = "--debug"

# Typer bundles click or depends on it, by version; the base classes are reached the same way in both.
_UsageError, _ClickError = typer.BadParameter.__mro__[1:3]


class _ClosedPipeError(Exception):
    """Who read what is written has gone."""


class LazyGroup(TyperGroup):
    """Commands by name from their modules; the one place where errors become exit codes."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Names in the order of the work."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The command, imported now; None where there is no such command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"edge.cli.{cmd_name}")
        single = typer.Typer(add_completion=False)
        single.command(cmd_name)(getattr(module, f"{cmd_name}_command"))
        return typer.main.get_command(single)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; a closed pipe is told apart before typer calls it a failure."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise _ClosedPipeError from error

    def main(self, args: Sequence[str] | None = None, *positional: Any, **options: Any) -> Any:
        """Run; ends the process with the exit code.

        ``--debug`` may stand anywhere on the line; with it, errors keep their traceback.
        """
        arguments = list(sys.argv[1:] if args is None else args)
        debug = DEBUG_FLAG in arguments
        arguments = [word for word in arguments if word != DEBUG_FLAG]
        options = {**options, "standalone_mode": False, "prog_name": "edge"}
        try:
            result = super().main(arguments, **options)
        except _ClosedPipeError:
            sys.stdout = open(os.devnull, "w")  # noqa: PTH123, SIM115 - the interpreter flushes it once more
            sys.exit(EXIT_BROKEN_PIPE)
        except (Exception, KeyboardInterrupt) as error:
            if debug:
                raise
            line, code = describe_failure(error, command=next(iter(arguments), ""))
            sys.stderr.write(line + "\n")
            sys.exit(code)
        sys.exit(result if isinstance(result, int) else 0)


def describe_failure(error: BaseException, *, command: str) -> tuple[str, int]:
    """The line for stderr and the exit code of an error.

    Args:
        error: what a command ended with.
        command: its name, for hints.
    """
    if isinstance(error, EdgeError):
        return f"error: {_one_line(str(error))}", error.exit_code
    if isinstance(error, _ClickError):
        message = _one_line(error.format_message()) or "no command given"  # type: ignore[attr-defined]
        where = f"edge {command}" if command in COMMANDS else "edge"
        return f"error: {message.rstrip('.')}; see `{where} --help`", EXIT_WRONG_INPUT
    if isinstance(error, ModuleNotFoundError) and _package(error) in EXTRA_OF_PACKAGE:
        missing = missing_extra(_package(error), command=command)
        return f"error: {missing}", missing.exit_code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        return "interrupted", EXIT_INTERRUPTED
    if isinstance(error, OSError):
        return (
            f"error: {_one_line(str(error))}; check the path, its permissions and the disk",
            EXIT_WRONG_INPUT,
        )
    hint = "this is a bug: run again with --debug for the traceback and report it"
    return f"error: {type(error).__name__}: {_one_line(str(error))}; {hint}", EXIT_BUG


def missing_extra(package: str, *, command: str) -> MissingExtraError:
    """The error for a package that is not installed.

    Args:
        package: top-level module name.
        command: the command that wanted it.
    """
    extra = EXTRA_OF_COMMAND.get(command, EXTRA_OF_PACKAGE[package])
    return MissingExtraError(f"`edge {command}` needs {package}, which is not installed; run: pip install '.[{extra}]'")


def _package(error: ModuleNotFoundError) -> str:
    return (error.name or "").partition(".")[0]


def _one_line(text: str) -> str:
    return " ".join(text.split())


app = typer.Typer(
    cls=LazyGroup,
    add_completion=False,
    no_args_is_help=True,
    help="Stereo 3D detection in INT8 on small computers: export, quantize, accuracy, stream, bench.",
)


@app.callback()
def _edge(
    debug: bool = typer.Option(False, DEBUG_FLAG, help="Show tracebacks; may stand anywhere on the line."),
) -> None:
    pass


def main() -> None:
    """Entry point of the ``edge`` script."""
    typer.main.get_command(app)()


if __name__ == "__main__":
    main()
