"""Who may import whom: the table of docs/architecture.md, read off the syntax trees and tried in subprocesses."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
ROOMS = frozenset({"runtime", "calib", "export", "quantize", "edge"})
ONNX = frozenset({"onnx", "onnxscript", "onnxsim"})
TORCH = frozenset({"torch", "torchvision"})
SLIM = ("numpy", "onnxruntime", "cv2", "typer", "rich")
SUBPROCESS_SECONDS = 60


@dataclass(frozen=True, slots=True)
class Rule:
    """What the files under a folder may import.

    Attributes:
        folder: relative to the repository.
        rooms: dotted prefixes of this project's modules that are allowed.
        packages: the only other packages allowed, the standard library aside; None for any.
        never: packages that are not.
    """

    folder: str
    rooms: tuple[str, ...]
    packages: frozenset[str] | None = None
    never: frozenset[str] = frozenset()


RULES = (
    Rule("runtime/contracts", ("runtime.contracts",), packages=frozenset({"numpy"})),
    Rule("runtime", ("runtime",), packages=frozenset({"numpy", "onnxruntime", "cv2", "depthai"})),
    Rule("calib", ("calib", "runtime"), never=TORCH),
    Rule("export", ("export", "runtime")),
    Rule("quantize", ("quantize", "calib", "runtime"), never=TORCH),
    Rule("edge/evaluation", ("edge.evaluation", "runtime"), never=TORCH | ONNX),
    Rule("edge/detector", ("edge", "export", "runtime"), never=ONNX | {"onnxruntime"}),
    Rule("edge/training", ("edge", "export", "quantize", "calib", "runtime"), never=ONNX | {"onnxruntime"}),
    Rule("edge/simulation", ("edge.simulation", "runtime"), never=ONNX | {"onnxruntime"} | TORCH),
    Rule("edge/report", ("edge.report", "edge.evaluation", "runtime"), never=TORCH | ONNX),
    Rule("edge/parity", ("edge.parity", "edge.report", "quantize", "runtime"), never=TORCH),
)
AT_IMPORT_OF_CLI = frozenset({"typer"})
"""All that ``edge/cli`` imports before a command runs, beside the standard library, itself and the contracts."""


def imported(tree: ast.AST, *, deferred: bool = True) -> Iterator[tuple[int, str]]:
    """Line and dotted name of every import.

    Args:
        tree: of a file; relative imports are banned, so all names are absolute.
        deferred: also those inside functions and under ``if TYPE_CHECKING``.
    """
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Import):
            yield from ((node.lineno, item.name) for item in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            yield node.lineno, node.module or ""
        elif deferred or not (
            isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda) or _is_for_types(node)
        ):
            yield from imported(node, deferred=deferred)


def _is_for_types(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


def violations(rule: Rule, tree: ast.AST) -> list[str]:
    """What a file imports against a rule, as text."""
    found = []
    for line, name in imported(tree):
        root = name.partition(".")[0]
        if root in sys.stdlib_module_names:
            continue
        if root in ROOMS:
            wrong = not any(name == room or name.startswith(f"{room}.") for room in rule.rooms)
        else:
            wrong = root in rule.never or (rule.packages is not None and root not in rule.packages)
        if wrong:
            found.append(f"line {line}: {name}")
    return found


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.folder)
def test_a_room_imports_only_what_it_may(rule: Rule) -> None:
    files = sorted((REPOSITORY / rule.folder).rglob("*.py"))
    assert files, f"{rule.folder} has no files: the table is out of date"
    found = {
        path.relative_to(REPOSITORY).as_posix(): wrong
        for path in files
        if (wrong := violations(rule, ast.parse(path.read_text(encoding="utf-8"))))
    }
    assert found == {}


def test_the_command_line_imports_nothing_heavy_before_a_command_runs() -> None:
    found = {}
    for path in sorted((REPOSITORY / "edge/cli").rglob("*.py")):
        names = [name for _, name in imported(ast.parse(path.read_text(encoding="utf-8")), deferred=False)]
        heavy = [
            name
            for name in names
            if name.partition(".")[0] not in sys.stdlib_module_names | AT_IMPORT_OF_CLI
            and not name.startswith(("edge.cli", "runtime.contracts."))
        ]
        if heavy:
            found[path.name] = heavy
    assert found == {}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("", 0),
        ("import json, numpy", 0),
        ("from runtime.contracts.frame import StereoFrame", 0),
        ("import runtime.anchors", 1),  # another part of the runtime
        ("import runtime.contractsx", 1),  # a prefix is whole words
        ("import cv2", 1),
        ("def late():\n    from onnxruntime import InferenceSession", 1),  # also where it runs later
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import edge.report.rows", 1),
    ],
)
def test_the_check_finds_what_breaks_the_rule(source: str, expected: int) -> None:
    assert len(violations(RULES[0], ast.parse(source))) == expected


def test_deferred_imports_do_not_count_at_import() -> None:
    source = (
        "from typing import TYPE_CHECKING\nimport typer\nif TYPE_CHECKING:\n    import torch\n"
        "def run():\n    import cv2\nclass A:\n    import numpy\ntry:\n    import onnx\nexcept ImportError:\n    pass\n"
    )
    assert [name for _, name in imported(ast.parse(source), deferred=False)] == ["typing", "typer", "numpy", "onnx"]


# Only these of what is installed beside the standard library; the packages' own dependencies are let through by
# asking who imports: a name is refused where one of this project's files asks for it.
BLOCKER = """
import builtins, sys
allowed, rooms = set({allowed!r}), set({rooms!r})
original = builtins.__import__
def guarded(name, globals=None, locals=None, fromlist=(), level=0):
    root = name.partition(".")[0]
    asking = ((globals or {{}}).get("__name__") or "").partition(".")[0]
    ours = asking in rooms or asking == "__main__"
    if level == 0 and ours and root not in allowed | rooms and root not in sys.stdlib_module_names:
        raise ModuleNotFoundError(f"No module named {{root!r}} (blocked)", name=root)
    return original(name, globals, locals, fromlist, level)
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name in {heavy!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}} (blocked)", name=name)
        return None
builtins.__import__ = guarded
sys.meta_path.insert(0, Finder())
"""
HEAVY = sorted(TORCH | ONNX | {"depthai", "moderngl", "glcontext", "matplotlib", "safetensors", "shapely", "av"})


def run_with(allowed: tuple[str, ...], code: str) -> subprocess.CompletedProcess[str]:
    """Runs code in a fresh interpreter in which this project's files can import ``allowed`` alone."""
    text = BLOCKER.format(allowed=allowed, rooms=sorted(ROOMS), heavy=HEAVY) + code
    return subprocess.run(
        [sys.executable, "-c", text],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        check=False,
        timeout=SUBPROCESS_SECONDS,
    )


def test_the_blocker_blocks() -> None:
    for name, allowed in (("torch", ("torch",)), ("cv2", ("numpy",)), ("matplotlib.pyplot", SLIM)):
        ran = run_with(allowed, f"import {name}")
        assert ran.returncode != 0
        assert "(blocked)" in ran.stderr


def test_anchors_need_numpy_alone() -> None:
    ran = run_with(("numpy",), "import runtime.anchors\nassert 'cv2' not in sys.modules")
    assert ran.returncode == 0, ran.stderr


SLIM_COMMANDS = ("stream", "evaluate", "bench", "accuracy", "doctor")


@pytest.mark.parametrize("command", SLIM_COMMANDS)
def test_the_slim_install_has_what_a_command_imports(command: str) -> None:
    """Also what its functions import only when it runs."""
    tree = ast.parse((REPOSITORY / f"edge/cli/{command}.py").read_text(encoding="utf-8"))
    names = sorted({name for _, name in imported(tree) if name.partition(".")[0] in ROOMS})
    assert names
    ran = run_with(SLIM, "".join(f"import {name}\n" for name in [f"edge.cli.{command}", *names]))
    assert ran.returncode == 0, ran.stderr


def test_the_command_line_starts_without_numpy() -> None:
    code = "import edge.cli.main\nassert not {'numpy', 'cv2', 'onnxruntime', 'torch', 'onnx'} & set(sys.modules)"
    ran = run_with(("typer",), code)
    assert ran.returncode == 0, ran.stderr
