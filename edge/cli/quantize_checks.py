"""What ``edge quantize`` checks and notes beside the figures: pixels before 8 bits are blamed, and how to repeat it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from edge.cli.shown_command import shown_command
from edge.cli.stages import warn

if TYPE_CHECKING:
    import typer

    from edge.report.parity import ParityRecord
    from edge.report.repeat import RepeatRecord
    from quantize.calibration import Calibration
    from quantize.prepare import Prepared
    from runtime.contracts.frame import StereoFrame
    from runtime.contracts.manifest import ModelDirectory

PARITY_FRAMES = 3
"""Calibration frames whose pixels are followed to the first convolution."""
_SHOWN_PROVENANCE = ("int8_range_method", "int8_adjustments", "int8_target")
SOURCES = frozenset({"calibration", "validation"})


def look_at_pixels(prepared: Prepared, written: ModelDirectory, frames: Sequence[StereoFrame]) -> ParityRecord:
    """Preprocessing parity of the float and the INT8 model; each failure is said in one line."""
    import onnx

    from edge.parity.check import check_parity

    models = {"float32": onnx.load(prepared.source.model_path), "INT8": onnx.load(written.model_path)}
    record = check_parity(models, frames, prepared.source.manifest)
    for check in record.failures:
        model = f" of {check.model}" if check.model else ""
        warn(f"parity: {check.what}{model}: found {check.found}; expected {check.limit}; {check.remedy}")
    return record


def how_to_repeat(
    context: typer.Context,
    prepared: Prepared,
    found: Calibration,
    written: ModelDirectory,
    *,
    given_back: Sequence[str],
) -> RepeatRecord:
    """The record of this run of the command."""
    from dataclasses import asdict

    from edge.report.repeat import RepeatRecord
    from runtime.contracts.manifest import MODEL_FILE, PRIORS_FILE

    words = shown_command(context, sources=SOURCES, chosen={"target": prepared.recipe.target})
    before, after = prepared.source.manifest.sha256, written.manifest.sha256
    settings: dict[str, Any] = {
        "calibration source": found.frames.source,
        "calibration frames": f"{len(found.frames.frames)} of {found.frames.available}",
        **{name.replace("_", " "): written.manifest.provenance[name] for name in _SHOWN_PROVENANCE},
        "given back to float": ", ".join(given_back) or "nothing",
    }
    return RepeatRecord(
        command=words,
        sha256={
            "the float model": before[MODEL_FILE],
            "the priors": before[PRIORS_FILE],
            "the INT8 model": after[MODEL_FILE],
            "the calibration pixels": found.frames.digest,
            "the calibration cameras": found.frames.geometry_digest,
        },
        recipe=asdict(prepared.recipe),
        settings=settings,
    )
