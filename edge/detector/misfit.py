"""What of a file of weights does not fit a network, by name and shape."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from edge.detector.checkpoint_file import Checkpoint
from runtime.contracts.errors import CheckpointError

SHOWN_NAMES = 5
_COUNTER = "num_batches_tracked"
Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True, slots=True)
class Misfit:
    """What of a checkpoint does not fit a network; false where all does.

    Attributes:
        checkpoint: the file's content.
        missing: what the network needs and the file lacks, with shapes; unknown: what it does not know, with shapes;
            misshapen: both shapes. Names are those of the file's kind.
    """

    checkpoint: Checkpoint
    missing: tuple[str, ...]
    unknown: tuple[str, ...]
    misshapen: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.missing) + len(self.unknown) + len(self.misshapen)

    def error(self) -> CheckpointError:
        """One line for the user."""
        listed = (("lacks", self.missing), ("has the unknown", self.unknown), ("has", self.misshapen))
        parts = [
            f"{label} {', '.join(names[:SHOWN_NAMES])}"
            + (f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else "")
            for label, names in listed
            if names
        ]
        return CheckpointError(
            f"{self.checkpoint.path} {'; '.join(parts)}; expected the weights of this preset: choose its --preset"
        )


def compare(own: Shapes, checkpoint: Checkpoint) -> Misfit:
    """Names and shapes of a network against those of a file.

    The disparity branch and the norms' counters may be missing: inference does without.
    """
    shapes = shapes_of(checkpoint.state)
    called = checkpoint.name_in_file
    missing = [name for name in own if name not in shapes and not _optional(name)]
    misshapen = [name for name in own if shapes.get(name, own[name]) != own[name]]
    unknown = [name for name in shapes if name not in own and not name.endswith(_COUNTER)]
    return Misfit(
        checkpoint,
        missing=tuple(f"{called(name)} {_text(own[name])}" for name in missing),
        unknown=tuple(f"{called(name)} {_text(shapes[name])}" for name in unknown),
        misshapen=tuple(f"{called(name)} {_text(shapes[name])} instead of {_text(own[name])}" for name in misshapen),
    )


def _optional(name: str) -> bool:
    return name.startswith("disparity_branch.") or name.endswith(_COUNTER)


def _text(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "scalar"


def shapes_of(state: Mapping[str, torch.Tensor]) -> dict[str, tuple[int, ...]]:
    """Shapes by name."""
    return {name: tuple(value.shape) for name, value in state.items()}
