"""What this machine is: processor, the instructions that decide INT8 speed, and package versions."""

from __future__ import annotations

import importlib.metadata
import os
import platform
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")
INTERESTING_FLAGS = {
    "x86_64": ("avx2", "avx_vnni", "avx512f", "avx512_vnni", "avx512_bf16", "amx_int8"),
    "aarch64": ("asimd", "asimddp", "i8mm", "sve", "bf16"),
}
"""By machine, as Linux names them; the INT8 dot products are avx_vnni, avx512_vnni, amx_int8, asimddp, i8mm."""
INT8_FLAGS = ("avx_vnni", "avx512_vnni", "amx_int8", "asimddp", "i8mm")
_FLAG_KEYS = ("flags", "Features")
_MODEL_KEYS = ("model name", "Model", "CPU part")


@dataclass(frozen=True, slots=True)
class Processor:
    """The CPU.

    Attributes:
        model: its name, or the machine kind where the system tells none; machine: ``x86_64``, ``aarch64``; cores: that
        this process may use; flags: the interesting ones that it has; None where the system does not tell.
    """

    model: str
    machine: str
    cores: int
    flags: tuple[str, ...] | None

    @property
    def has_int8_dot_products(self) -> bool:
        """Whether INT8 has instructions of its own here."""
        return any(flag in INT8_FLAGS for flag in self.flags or ())


def tool_versions(packages: Iterable[str]) -> dict[str, str]:
    """Versions of Python and of what made a file; ``unknown`` for a package that goes by another name here."""
    return {"python": platform.python_version(), **{name: package_version(name) or "unknown" for name in packages}}


def processor() -> Processor:
    """The processor of this machine."""
    text = CPU_INFO.read_text(encoding="utf-8", errors="replace") if CPU_INFO.is_file() else ""
    return parse_cpu_info(text, machine=platform.machine(), cores=usable_cores())


def parse_cpu_info(text: str, *, machine: str, cores: int) -> Processor:
    """Reads Linux's ``/proc/cpuinfo``; an empty text is a system without it."""
    model, flags = machine, None
    for line in text.splitlines():
        key, _, value = (part.strip() for part in line.partition(":"))
        if key in _MODEL_KEYS and model == machine and value:
            model = value
        if key in _FLAG_KEYS and flags is None:
            present = set(value.split())
            flags = tuple(flag for flag in INTERESTING_FLAGS.get(machine, ()) if flag in present)
    return Processor(model, machine, cores, flags)


def usable_cores() -> int:
    """Cores that this process may run on."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def package_version(distribution: str) -> str | None:
    """Version of an installed distribution, None where it is not installed."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return None
