"""Weights in and out: safetensors of our own, official checkpoints, ImageNet backbones."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import nn

from edge.detector.build import Detector
from edge.detector.checkpoint_file import Checkpoint, read_checkpoint
from edge.detector.misfit import compare, shapes_of
from edge.detector.presets import Preset
from runtime.contracts.errors import CheckpointError
from runtime.contracts.manifest import AnchorPriors

PRIORS_KEY = "priors_sha256"
"""Metadata key of the weights file: `priors_digest` of what they were trained with."""


def save_weights(path: Path, state: dict[str, torch.Tensor], *, metadata: dict[str, str]) -> None:
    """Write weights as float16 safetensors, beside its place and renamed; the norms' counters stay out.

    The disparity branch is among them, although only training uses it: a run that starts from the file with a random
    one spends its first hundreds of steps on what its neck knew already.
    """
    kept = {
        name: value.to(torch.float16).contiguous() if value.dtype.is_floating_point else value
        for name, value in state.items()
        if not name.endswith("num_batches_tracked")
    }
    beside = path.with_name(path.name + ".part")
    save_file(kept, beside, metadata=metadata)
    beside.replace(path)


def load_weights(detector: nn.Module, source: Path | Checkpoint) -> None:
    """Load weights written by `save_weights`, a run's checkpoint (its averaged model), or an official checkpoint.

    Raises:
        CheckpointError: unreadable, names or shapes that do not fit the preset, or values that are not finite.
    """
    checkpoint = read_checkpoint(source) if isinstance(source, Path) else source
    own = detector.state_dict()
    misfit = compare(shapes_of(own), checkpoint)
    if misfit:
        raise misfit.error()
    for name, value in checkpoint.state.items():
        if value.dtype.is_floating_point and not torch.isfinite(value).all():
            raise CheckpointError(
                f"{checkpoint.path} has values in {checkpoint.name_in_file(name)} that are not finite, expected "
                "finite weights; its training diverged: take an earlier checkpoint"
            )
    known = {name: value.to(own[name].dtype) for name, value in checkpoint.state.items() if name in own}
    detector.load_state_dict(known, strict=False)


def check_priors(path: Path, tables: AnchorPriors, classes: tuple[str, ...]) -> None:
    """Refuse priors other than those that the weights were trained with, where the weights name theirs.

    Raises:
        CheckpointError: the hash that `save_weights` was given differs.
    """
    if path.suffix != ".safetensors":
        return
    with safe_open(path, framework="pt") as file:
        expected = (file.metadata() or {}).get(PRIORS_KEY)
    if expected is not None and priors_digest(tables, classes) != expected:
        raise CheckpointError(
            f"{path} was trained with other priors, expected the tables that lie beside it; give those by --priors"
        )


def has_disparity_branch(path: Path) -> bool:
    """Whether a safetensors file holds the branch that training alone uses; others are taken to hold it."""
    if path.suffix != ".safetensors":
        return True
    with safe_open(path, framework="pt") as file:
        return any(name.startswith("disparity_branch.") for name in file.keys())  # noqa: SIM118 - it is no dict


def check_ablations(path: Path, preset: Preset) -> None:
    """Refuse weights that were trained with other ablations than the preset has.

    Some of them change what the outputs mean and no shape; a file that does not name its preset passes.

    Raises:
        CheckpointError: the ablations in the preset's name that `save_weights` was given differ.
    """
    if path.suffix != ".safetensors":
        return
    with safe_open(path, framework="pt") as file:
        trained = (file.metadata() or {}).get("preset")
    if trained is None:
        return
    found, given = (set(name.split("+")[1:]) for name in (trained, preset.name))
    if found != given:
        flags = " ".join(f"--ablate {name}" for name in sorted(found)) or "no --ablate"
        raise CheckpointError(
            f"{path} was trained as {trained}, expected the same ablations as {preset.name}; give {flags}"
        )


def priors_digest(tables: AnchorPriors, classes: tuple[str, ...]) -> str:
    """Hex SHA-256 of the tables' values and the classes they are for, whatever file holds them."""
    digest = hashlib.sha256(" ".join(classes).encode())
    for table in (tables.mean, tables.std):
        digest.update(np.ascontiguousarray(table, np.float32).tobytes())
    return digest.hexdigest()


def load_backbone(detector: Detector, path: Path) -> None:
    """Start the backbone from ImageNet weights with torchvision's names; later stages in the file are ignored.

    Raises:
        CheckpointError: a tensor that the backbone needs is missing or has another shape.
    """
    state = read_checkpoint(path).state
    own = detector.backbone.state_dict()
    wanted = [name for name in own if not name.endswith("num_batches_tracked")]
    wrong = [name for name in wanted if name not in state or state[name].shape != own[name].shape]
    if wrong:
        raise CheckpointError(
            f"{path} does not fit the backbone at {wrong[0]}, expected a ResNet of the preset's depth and width; "
            "give fitting ImageNet weights"
        )
    detector.backbone.load_state_dict({name: state[name].float() for name in wanted}, strict=False)
