"""Writes a model directory beside its place and renames it, so that no half-written one is ever seen."""

from __future__ import annotations

import dataclasses
import platform
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path

import onnx

from runtime.contracts.errors import OutputError
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

CARD_FILE = "card.md"
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
        written = dataclasses.replace(manifest, sha256=hashes, tools=tool_versions())
        (folder / MANIFEST_FILE).write_text(format_manifest(written), encoding="utf-8")
        (folder / CARD_FILE).write_text(card, encoding="utf-8")
    return written


@contextmanager
def replaced_directory(out: Path) -> Iterator[Path]:
    """Gives an empty folder beside ``out`` and renames it to ``out`` when the block ends without an error.

    Raises:
        OutputError: ``out`` is a file, or a folder that is neither empty nor a model directory, or cannot be
            written.
    """
    if out.exists() and not (out.is_dir() and (not any(out.iterdir()) or (out / MANIFEST_FILE).is_file())):
        raise OutputError(
            f"{out}: found something that is no model directory; expected a free place or an older model"
            " directory; choose another --out"
        )
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise _unwritable(out, error) from error
    try:
        folder = staging / "new"
        folder.mkdir()  # mkdtemp's own mode keeps other users out; this one follows the umask
        yield folder
        _swap(folder, out, retired=staging / "old")
    except OSError as error:
        raise _unwritable(out, error) from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def tool_versions() -> dict[str, str]:
    """Versions of what made the file."""
    return {"python": platform.python_version(), **{name: version(name) for name in _TOOLS}}


def _swap(folder: Path, out: Path, *, retired: Path) -> None:
    """Renames ``folder`` to ``out``; puts what was there back if that fails."""
    if out.exists():
        out.rename(retired)
    try:
        folder.rename(out)
    except OSError:
        if retired.exists():
            retired.rename(out)
        raise


def _unwritable(out: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{out}: found that it cannot be written ({error.strerror}); expected a writable folder; choose"
        " another --out"
    )
