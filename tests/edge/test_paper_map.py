"""docs/paper.md names files and ablations that are there, and the files name their sections."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

from edge.detector.ablations import ABLATIONS

REPOSITORY = Path(__file__).resolve().parents[2]
PAGE = (REPOSITORY / "docs" / "paper.md").read_text(encoding="utf-8")
NAMED = re.compile(r"`((?:edge|runtime|export)/[\w/]+(?:\.\w+|/))`")
LEARNING = re.compile(r"edge/(?:detector|training)/.*\.py")
SECTION = re.compile(r"section[s]? (?:III|IV|V)\b|paper, III-")


def test_every_file_of_the_map_is_there() -> None:
    paths = NAMED.findall(PAGE)
    assert len(paths) > 20
    assert [path for path in paths if not (REPOSITORY / path).exists()] == []


@pytest.mark.parametrize(
    "path", sorted({path for path in NAMED.findall(PAGE) if re.match(r"edge/(det|tra).*py", path)})
)
def test_each_file_names_its_section(path: str) -> None:
    tree = ast.parse((REPOSITORY / path).read_text(encoding="utf-8"))
    places = [node for node in ast.walk(tree) if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
    assert any(SECTION.search(ast.get_docstring(node) or "") for node in places)


def test_the_table_holds_every_ablation_and_no_other() -> None:
    rows = [line for line in PAGE.splitlines() if line.startswith("|") and "=" in line]
    named = {name for row in rows for name in re.findall(r"\| `([a-z0-9-]+)` \|", row)}
    assert named == set(ABLATIONS)
