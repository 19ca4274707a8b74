"""Weights in and out: safetensors of our own, official checkpoints, ImageNet backbones."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file

from edge.detector.network import StereoDetector
from edge.detector.official import from_official, is_official
from runtime.contracts.errors import CheckpointError
from runtime.contracts.manifest import AnchorPriors

SHOWN_NAMES = 3
PRIORS_KEY = "priors_sha256"
"""Metadata key of the weights file: `priors_digest` of what they were trained with."""


def save_weights(path: Path, state: dict[str, torch.Tensor], *, metadata: dict[str, str]) -> None:
    """Write inference weights as float16 safetensors, beside its place and renamed; the disparity branch stays out."""
    kept = {
        name: value.to(torch.float16).contiguous() if value.dtype.is_floating_point else value
        for name, value in state.items()
        if not name.startswith("disparity_branch.") and not name.endswith("num_batches_tracked")
    }
    beside = path.with_name(path.name + ".part")
    save_file(kept, beside, metadata=metadata)
    beside.replace(path)


def load_weights(detector: StereoDetector, path: Path) -> None:
    """Load weights written by `save_weights` or a run's checkpoint (its averaged model).

    Raises:
        CheckpointError: unreadable, or names or shapes that do not fit the preset.
    """
    state = read_state(path)
    own = detector.state_dict()
    optional = {name for name in own if name.startswith("disparity_branch.") or name.endswith("num_batches_tracked")}
    missing = sorted(set(own) - set(state) - optional)
    unknown = sorted(set(state) - set(own))
    misfits = sorted(
        f"{name} {tuple(state[name].shape)} instead of {tuple(own[name].shape)}"
        for name in set(own) & set(state)
        if state[name].shape != own[name].shape
    )
    if missing or unknown or misfits:
        parts = [
            f"{label} {', '.join(names[:SHOWN_NAMES])}{' and more' if len(names) > SHOWN_NAMES else ''}"
            for label, names in (("lacks", missing), ("has the unknown", unknown), ("has", misfits))
            if names
        ]
        raise CheckpointError(f"{path} {'; '.join(parts)}; expected the weights of this preset: choose its --preset")
    detector.load_state_dict({name: value.to(own[name].dtype) for name, value in state.items()}, strict=False)


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


def priors_digest(tables: AnchorPriors, classes: tuple[str, ...]) -> str:
    """Hex SHA-256 of the tables' values and the classes they are for, whatever file holds them."""
    digest = hashlib.sha256(" ".join(classes).encode())
    for table in (tables.mean, tables.std):
        digest.update(np.ascontiguousarray(table, np.float32).tobytes())
    return digest.hexdigest()


def read_state(path: Path) -> dict[str, torch.Tensor]:
    """Names to tensors of a safetensors file or a torch checkpoint (ours or official); pickles never run.

    Raises:
        CheckpointError: missing or unreadable.
    """
    if not path.is_file():
        raise CheckpointError(f"{path} is not there, expected weights (.safetensors or .pt); check the path")
    if path.suffix == ".safetensors":
        try:
            return dict(load_file(path))
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{path} is no safetensors file ({error}); expected weights; copy it again") from None
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        raise CheckpointError(
            f"{path} is not readable as weights ({type(error).__name__}), expected a state dict; copy it again"
        ) from None
    for key in ("average", "state_dict", "model"):
        if isinstance(data, dict) and isinstance(data.get(key), dict):
            data = data[key]
            break
    if not isinstance(data, dict) or not all(isinstance(value, torch.Tensor) for value in data.values()):
        raise CheckpointError(f"{path} holds no tensors by name, expected a state dict; copy it again")
    plain = {name.removeprefix("module."): value for name, value in data.items()}
    return from_official(plain) if is_official(plain) else plain


def load_backbone(detector: StereoDetector, path: Path) -> None:
    """Start the backbone from ImageNet weights with torchvision's names; later stages in the file are ignored.

    Raises:
        CheckpointError: a tensor that the backbone needs is missing or has another shape.
    """
    state = read_state(path)
    own = detector.backbone.state_dict()
    wanted = [name for name in own if not name.endswith("num_batches_tracked")]
    wrong = [name for name in wanted if name not in state or state[name].shape != own[name].shape]
    if wrong:
        raise CheckpointError(
            f"{path} does not fit the backbone at {wrong[0]}, expected a ResNet of the preset's depth and width; "
            "give fitting ImageNet weights"
        )
    detector.backbone.load_state_dict({name: state[name].float() for name in wanted}, strict=False)
