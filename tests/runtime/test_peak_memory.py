"""Peak memory of a model in a process of its own."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest

from runtime import peak_memory as module
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.peak_memory import STATUS, peak_memory, status_mib

LEAST_MIB, MOST_MIB = 20.0, 1000.0  # an interpreter with numpy and ONNX Runtime, and a model of a few kilobytes

if not STATUS.is_file():
    pytest.skip("this system does not tell a process's memory", allow_module_level=True)


def frame(with_right: bool = True) -> StereoFrame:
    P2 = np.array([[200.0, 0, 64, 0], [0, 200.0, 32, 0], [0, 0, 1, 0]])
    P3 = P2.copy()
    P3[0, 3] = -100.0
    image = np.full((64, 128, 3), 200, np.uint8)
    return StereoFrame(image, image if with_right else None, 0.0, 0, "a", StereoGeometry(P2, P3, (128, 64)))


def test_a_model_has_a_peak_above_what_was_there_before(tiny_model: Path) -> None:
    found = peak_memory(tiny_model, frame())
    assert found is not None
    assert LEAST_MIB < found.before_mib < found.peak_mib < MOST_MIB


def test_what_cannot_be_run_has_none(tiny_model: Path, tmp_path: Path) -> None:
    assert peak_memory(tmp_path / "nowhere", frame()) is None
    assert peak_memory(tiny_model, frame(with_right=False)) is None  # a stereo model wants both


def test_a_system_that_does_not_tell(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tiny_model: Path) -> None:
    monkeypatch.setattr(module, "STATUS", tmp_path / "none")
    assert peak_memory(tiny_model, frame()) is None


def test_a_system_that_tells_other_sizes(monkeypatch: pytest.MonkeyPatch, tiny_model: Path) -> None:
    told = subprocess.CompletedProcess([], 0, stdout=b"nan nan\n")
    monkeypatch.setattr(subprocess, "run", lambda *words, **options: told)
    assert peak_memory(tiny_model, frame()) is None


def test_sizes_are_read_by_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "status").write_text("Name:\tpython\nVmHWM:\t  2048 kB\nVmRSS:\t 512 kB\n", encoding="ascii")
    monkeypatch.setattr(module, "STATUS", tmp_path / "status")
    assert (status_mib("VmHWM"), status_mib("VmRSS")) == (2.0, 0.5)
    assert np.isnan(status_mib("VmSwap"))
