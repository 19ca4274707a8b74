"""Peak memory of a process that does nothing but run one model, measured in a fresh one.

In a process that has loaded other models before, memory that they freed is used again, and what a model adds says
little. So the frame goes through a pipe to a new interpreter, which loads the model, runs it, and tells the highest
resident memory that it ever had (``VmHWM`` of Linux), and what it had before the model was loaded.
"""

from __future__ import annotations

import io
import math
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry

STATUS = Path("/proc/self/status")
RUNS = 2
"""The first run may allocate what the second one uses again; more show nothing new."""
LIMIT_SECS = 120.0
_KIBI, _MEBI_IN_KIBI = "kB", 1024.0


@dataclass(frozen=True, slots=True)
class PeakMemory:
    """Resident memory in MiB.

    Attributes:
        peak_mib: the most that the process had; before_mib: what Python and the packages had before the model.
    """

    peak_mib: float
    before_mib: float


def peak_memory(model: Path | str, frame: StereoFrame) -> PeakMemory | None:
    """Runs a model directory in a process of its own.

    Args:
        model: the directory.
        frame: what it is shown; its camera is accepted whatever it is.

    Returns:
        The memory; None where the system does not tell, or the process did not end well in time.
    """
    if not STATUS.is_file():
        return None
    arrays = {"left": frame.left, "P2": frame.geometry.P2, "P3": frame.geometry.P3}
    if frame.right is not None:
        arrays["right"] = frame.right
    packed = io.BytesIO()
    np.savez(packed, **arrays)  # type: ignore[arg-type]
    command = [sys.executable, "-m", "runtime.peak_memory", str(model)]
    try:
        done = subprocess.run(command, input=packed.getvalue(), capture_output=True, timeout=LIMIT_SECS, check=True)
        peak, before = (float(word) for word in done.stdout.split())
    except (OSError, subprocess.SubprocessError, ValueError):
        return None
    return PeakMemory(peak, before) if math.isfinite(peak + before) else None


def status_mib(key: str) -> float:
    """A size of this process in MiB, for example ``VmHWM``; NaN where the system does not tell."""
    for line in STATUS.read_text(encoding="ascii", errors="replace").splitlines():
        name, _, value = line.partition(":")
        words = value.split()
        if name == key and len(words) == 2 and words[1] == _KIBI:
            return float(words[0]) / _MEBI_IN_KIBI
    return float("nan")


def _measure(model: str, packed: bytes) -> tuple[float, float]:
    from runtime.detector import open_detector

    with np.load(io.BytesIO(packed), allow_pickle=False) as arrays:
        left, right = arrays["left"], arrays.get("right")
        geometry = StereoGeometry(arrays["P2"], arrays["P3"], (left.shape[1], left.shape[0]))
    frame = StereoFrame(left, right, 0.0, 0, "frame", geometry)
    before_mib = status_mib("VmRSS")
    with open_detector(model, allow_other_rig=True, warn=lambda line: None) as detector:
        for _ in range(RUNS):
            detector(frame)
    return status_mib("VmHWM"), before_mib


if __name__ == "__main__":
    sys.stdout.write("{} {}\n".format(*_measure(sys.argv[1], sys.stdin.buffer.read())))
