"""All that is needed to make a model again: the command, what went in by hash, with what tools, on what machine."""

from __future__ import annotations

import os
import platform
import shlex
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from edge.evaluation.bootstrap import DRAWS, SEED
from runtime.machine import Processor, package_version, processor
from runtime.native.library import instruction_set

TOOLS = ("stereo-edge", "numpy", "onnx", "onnxruntime", "onnxsim", "opencv-python-headless")
SWITCHES = ("EDGE_NATIVE", "EDGE_NATIVE_ISA", "OMP_NUM_THREADS")
"""Environment variables that change what runs or how fast."""


@dataclass(frozen=True, slots=True)
class RepeatRecord:
    """What `edge quantize` was given and found around it.

    Attributes:
        command: words of a command line that asks for the same; paths and sources by their last parts.
        sha256: file or set of pixels -> hash (float model, priors, INT8 model, calibration pixels and cameras).
        recipe: name -> value of all that the recipe says.
        settings: what else decides the result (range method, frames wanted and had, sources, layers given back).
        tools: distribution -> version, None where it is missing; Python among them.
        processor: of this machine.
        native: instruction set of the correlation library; None where its function body serves.
        environment: switches that are set.
    """

    command: tuple[str, ...]
    sha256: Mapping[str, str]
    recipe: Mapping[str, Any]
    settings: Mapping[str, Any]
    tools: Mapping[str, str | None] = field(default_factory=lambda: tool_versions())
    processor: Processor = field(default_factory=processor)
    native: str | None = field(default_factory=instruction_set)
    environment: Mapping[str, str] = field(default_factory=lambda: switches())

    @property
    def command_line(self) -> str:
        """The command for a shell."""
        return shlex.join(self.command)

    def as_json(self) -> dict[str, Any]:
        """For report.json."""
        return {
            "command": list(self.command),
            "sha256": dict(self.sha256),
            "recipe": dict(self.recipe),
            "settings": dict(self.settings),
            "tools": dict(self.tools),
            "machine": asdict(self.processor),
            "native_correlation": self.native,
            "environment": dict(self.environment),
            "bootstrap": {"seed": SEED, "draws": DRAWS},
        }


def tool_versions() -> dict[str, str | None]:
    """Versions of what takes part."""
    return {"python": platform.python_version(), **{name: package_version(name) for name in TOOLS}}


def switches() -> dict[str, str]:
    """Environment variables that matter and are set."""
    return {name: os.environ[name] for name in SWITCHES if name in os.environ}


def repeat_text(record: RepeatRecord) -> str:
    """The section of report.md; ends with a blank line."""
    flags = ", ".join(record.processor.flags or ()) or "none told"
    kernel = record.native or "function body, no native library"
    lines = [
        "### To repeat it",
        "",
        "```sh",
        record.command_line,
        "```",
        "",
        "Folders are shown by their last part. Nothing is drawn at random but the bootstrap of the intervals "
        f"(seed {SEED}, {DRAWS:,} draws); the INT8 file comes out the same to the bit with the same tools.",
        "",
        *(f"- SHA-256 of {name}: `{value}`" for name, value in record.sha256.items()),
        *(f"- {name}: {value}" for name, value in record.settings.items()),
        f"- tools: {', '.join(f'{name} {value}' for name, value in record.tools.items() if value)}",
        f"- processor: {record.processor.model}, {record.processor.machine}, {record.processor.cores} cores, {flags}",
        f"- correlation kernel: {kernel}",
    ]
    if record.environment:
        lines.append(f"- environment: {', '.join(f'{name}={value}' for name, value in record.environment.items())}")
    return "\n".join(lines) + "\n\n"
