"""Finding the library, asking it, and installing without a compiler."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.native import library
from runtime.native.build import LIBRARY_NAME

INSTRUCTION_SETS = ("vnni", "avx512", "avx2", "neon", "scalar")
REPOSITORY = Path(__file__).resolve().parents[3]


def test_nothing_built_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(library, "library_path", lambda: None)
    assert library.instruction_set() is None


def test_a_broken_file_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    broken = tmp_path / LIBRARY_NAME
    broken.write_bytes(b"no library")
    monkeypatch.setattr(library, "library_path", lambda: broken)
    assert library.instruction_set() is None


@pytest.mark.usefixtures("native_library")
def test_environment_lowers_the_instruction_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EDGE_NATIVE_ISA", raising=False)
    assert library.instruction_set() in INSTRUCTION_SETS
    monkeypatch.setenv("EDGE_NATIVE_ISA", "scalar")
    assert library.instruction_set() == "scalar"
    monkeypatch.setenv("EDGE_NATIVE_ISA", "unheard")
    assert library.instruction_set() is None


def test_installing_without_a_compiler_succeeds_and_says_so_once(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    command = [sys.executable, "setup.py", "--quiet", "build_ext", "--build-lib", tmp_path, "--build-temp", tmp_path]
    environment = os.environ | {"CXX": str(tmp_path / "no-such-compiler")}
    ran = subprocess.run(
        command, cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=False, timeout=120
    )
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr.count("native correlation library:") == 1
    assert "function body serves" in ran.stderr
    assert not list(tmp_path.rglob("*.so"))
