"""Writes the INT8 model directory: graph, manifest, priors, card, choice of calibration frames."""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Collection
from pathlib import Path

import onnx

from calib.choice_record import choice_text
from quantize.calibration import Calibration
from quantize.errors import QuantizeError
from quantize.prepare import Prepared
from quantize.qdq import QuantisedGraph
from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    Manifest,
    ModelDirectory,
    file_sha256,
    format_manifest,
    open_model_directory,
)
from runtime.machine import tool_versions
from runtime.model_folder import CALIBRATION_FILE, CARD_FILE, replaced_directory

_TOOLS = ("onnx", "onnxruntime", "numpy")


def write_directory(
    prepared: Prepared,
    graph: QuantisedGraph,
    calibration: Calibration,
    out: Path,
    *,
    method: str,
    given_back: Collection[str] = (),
) -> ModelDirectory:
    """Writes the INT8 model directory: graph, manifest, priors as they were, card with what was done, frames.

    Raises:
        QuantizeError: ``out`` is the directory of the float model.
        OutputError: The place is taken or cannot be written.
    """
    source = prepared.source
    if out.resolve() == source.path.resolve():
        raise QuantizeError(
            f"--out: found the float model's own directory {out}; expected another; choose another place"
        )
    onnx.checker.check_model(graph.model)
    with replaced_directory(out) as folder:
        onnx.save(graph.model, folder / MODEL_FILE)
        shutil.copyfile(source.path / PRIORS_FILE, folder / PRIORS_FILE)
        manifest = _manifest(prepared, calibration, folder, method=method, given_back=given_back)
        (folder / CALIBRATION_FILE).write_text(choice_text(calibration.frames), encoding="utf-8")
        (folder / MANIFEST_FILE).write_text(format_manifest(manifest), encoding="utf-8")
        card = _card(source.path, manifest, calibration_frames=len(calibration.frames.frames))
        (folder / CARD_FILE).write_text(card, encoding="utf-8")
    return open_model_directory(out)


def _manifest(
    prepared: Prepared,
    calibration: Calibration,
    folder: Path,
    *,
    method: str,
    given_back: Collection[str],
) -> Manifest:
    old, frames = prepared.source.manifest, calibration.frames
    provenance = {
        **old.provenance,
        "float_model_sha256": old.sha256[MODEL_FILE],
        "int8_target": prepared.recipe.target,
        "int8_range_method": method,
        "int8_adjustments": prepared.recipe.adjustments,
        "calibration_source": frames.source,
        "calibration_frames": " ".join(frame.frame_id for frame in frames.frames),
        "calibration_pixels_sha256": frames.digest,
        "given_back_to_float": " ".join(sorted(given_back)) or "none",
    }
    tools = {**old.tools, **tool_versions(_TOOLS)}
    return dataclasses.replace(
        old,
        recipe=prepared.recipe.name,
        sha256={name: file_sha256(folder / name) for name in (MODEL_FILE, PRIORS_FILE)},
        tools=tools,
        provenance=provenance,
    )


def _card(source: Path, manifest: Manifest, *, calibration_frames: int) -> str:
    """The float model's card with a section on INT8."""
    path = source / CARD_FILE
    before = path.read_text(encoding="utf-8", errors="replace").rstrip() if path.is_file() else f"# {manifest.preset}"
    before = re.sub(r"^# .*", f"# {manifest.preset}, {manifest.recipe}", before, count=1)
    facts = manifest.provenance
    return (
        f"{before}\n\n## INT8\n\n"
        f"Recipe `{manifest.recipe}` for {facts['int8_target']}; ranges by {facts['int8_range_method']} from "
        f"{calibration_frames} frames of `{facts['calibration_source']}` (pixels "
        f"{facts['calibration_pixels_sha256'][:12]}); {facts['int8_adjustments']}.\n"
        f"Layers given back to float: {facts['given_back_to_float']}.\n"
        "The ranges are learned from the calibration frames; the licence of those frames goes with them.\n"
    )
