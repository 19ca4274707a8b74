"""Reads files of weights: our safetensors, torch checkpoints of ours or of the official code. Pickles never run."""

from __future__ import annotations

import pickle  # noqa: TID251 - for the name of the error alone
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from edge.detector.official import from_official, is_official, is_weight, official_name
from runtime.contracts.errors import CheckpointError

_WRAPPERS = ("average", "model_state_dict", "state_dict", "model", "net", "network")
"""Keys under which training loops keep the weights beside their own state."""
_PARALLEL = "module."


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """Weights by name.

    Attributes:
        path: the file.
        state: tensors by the names of `StereoDetector`.
        official: whether the file has the official code's names.
        left_out: names of the file that are no weights (loss constants, cached anchors).
    """

    path: Path
    state: dict[str, torch.Tensor]
    official: bool = False
    left_out: tuple[str, ...] = ()

    def name_in_file(self, name: str) -> str:
        """What the file calls, or should call, a tensor of ours."""
        return official_name(name) if self.official else name


def read_checkpoint(path: Path) -> Checkpoint:
    """Reads a file of weights.

    Raises:
        CheckpointError: missing, unreadable, or without tensors by name.
    """
    if not path.is_file():
        raise CheckpointError(f"{path} is not there, expected weights (.safetensors or .pt); check the path")
    plain = {_without_parallel(name): value for name, value in _named_tensors(path).items()}
    if not is_official(plain):
        return Checkpoint(path, plain)
    return Checkpoint(path, from_official(plain), True, tuple(name for name in plain if not is_weight(name)))


def _without_parallel(name: str) -> str:
    while name.startswith(_PARALLEL):  # a distributed model may wrap a parallel one
        name = name.removeprefix(_PARALLEL)
    return name


def _named_tensors(path: Path) -> dict[str, torch.Tensor]:
    if path.suffix == ".safetensors":
        try:
            return dict(load_file(path))
        except (SafetensorError, OSError) as error:
            raise CheckpointError(f"{path} is no safetensors file ({error}); expected weights; copy it again") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about pickle protocols; what cannot be read is an error
            data = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise CheckpointError(
            f"{path} holds more than tensors and numbers, which would run code when read; expected a state dict; "
            "save model.state_dict() alone"
        ) from None
    except (RuntimeError, OSError, EOFError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise CheckpointError(
            f"{path} is not readable as weights ({type(error).__name__}), expected a state dict; copy it again"
        ) from None
    tensors = _unwrapped(data)
    if not tensors or not all(isinstance(value, torch.Tensor) for value in tensors.values()):
        raise CheckpointError(f"{path} holds no tensors by name, expected a state dict; copy it again")
    return dict(tensors)


def _unwrapped(data: Any) -> Mapping[str, Any]:
    """The state dict itself, or the one that a training loop's record holds."""
    for key in _WRAPPERS:
        if isinstance(data, Mapping) and isinstance(data.get(key), Mapping):
            return _unwrapped(data[key])
    return data if isinstance(data, Mapping) and all(isinstance(key, str) for key in data) else {}
