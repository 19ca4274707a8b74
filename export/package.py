"""Writes a model directory beside its place and renames it, so that no half-written one is ever seen."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import onnx

from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    AnchorPriors,
    Manifest,
    file_sha256,
    format_manifest,
    write_priors,
)
from runtime.machine import tool_versions
from runtime.model_folder import CARD_FILE, replaced_directory

_TOOLS = ("torch", "onnx", "onnxscript", "onnxsim", "onnxruntime", "numpy")


def write_model_directory(
    out: Path, model: onnx.ModelProto, manifest: Manifest, *, priors: AnchorPriors, card: str
) -> Manifest:
    """Writes one model directory.

    Args:
        out: Its place. A model directory that is there already is replaced; anything else is left alone.
        model: The finished graph.
        manifest: All but hashes and tool versions, which are filled in here.
        priors: Anchor statistics, in the order of the manifest's classes.
        card: Text of ``card.md``: data, licence, limits.

    Returns:
        The manifest as written.

    Raises:
        OutputError: The place is taken by something else, or cannot be written.
    """
    with replaced_directory(out) as folder:
        onnx.save(model, folder / MODEL_FILE)
        write_priors(folder / PRIORS_FILE, manifest.classes, priors)
        hashes = {name: file_sha256(folder / name) for name in (MODEL_FILE, PRIORS_FILE)}
        written = dataclasses.replace(manifest, sha256=hashes, tools=tool_versions(_TOOLS))
        (folder / MANIFEST_FILE).write_text(format_manifest(written), encoding="utf-8")
        (folder / CARD_FILE).write_text(card, encoding="utf-8")
    return written
