"""Finding the library, asking it, and installing without a compiler."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.native import build, library
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


def test_an_outdated_library_does_not_outlive_a_failed_build(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It would be loaded although the message says that the function body serves."""
    outdated, source = tmp_path / LIBRARY_NAME, tmp_path / "register.cc"
    outdated.write_bytes(b"of an older build")
    source.write_text("", encoding="utf-8")
    os.utime(outdated, (1.0, 1.0))
    monkeypatch.setattr(build, "SOURCE_DIRECTORY", tmp_path)
    monkeypatch.setenv("CXX", str(tmp_path / "no-such-compiler"))
    assert build.main() == 0
    assert "function body serves" in capsys.readouterr().err
    assert not outdated.exists()


@pytest.mark.usefixtures("native_library")
def test_environment_lowers_the_instruction_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("EDGE_NATIVE_ISA", raising=False)
    assert library.instruction_set() in INSTRUCTION_SETS
    monkeypatch.setenv("EDGE_NATIVE_ISA", "scalar")
    assert library.instruction_set() == "scalar"
    monkeypatch.setenv("EDGE_NATIVE_ISA", "unheard")
    assert library.instruction_set() is None


class OfAnotherBuild(ctypes.Structure):
    """A record that no function of the library takes."""

    _fields_ = (("number", ctypes.c_int64),)


@pytest.mark.usefixtures("native_library")
@pytest.mark.parametrize(("symbol", "records"), [("EdgeSuppress", 1), ("EdgeVote", 1), ("EdgeRefineDepths", 2)])
def test_records_of_another_build_are_refused(symbol: str, records: int) -> None:
    call = library.record_call(symbol)
    assert call is not None
    assert call(*(OfAnotherBuild() for _ in range(records))) is False


def test_a_function_that_is_not_there_is_none(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    assert library.record_call("EdgeUnheard") is None
    broken = tmp_path / LIBRARY_NAME
    broken.write_bytes(b"no library")
    monkeypatch.setattr(library, "library_path", lambda: broken)
    assert library.record_call("EdgeVote") is None


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
