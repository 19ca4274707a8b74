"""The file of `edge confidence`: weights of scores that know depth, by class, and where they were learned."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from runtime.contracts.errors import FormatError

SCHEMA = 1


@dataclass(frozen=True, slots=True)
class ConfidenceRecord:
    """Weights for a manifest's ``confidence``.

    Attributes:
        weights: class to one number a feature of `runtime.refinement.confidence`, and the constant.
        facts: where they were learned.
    """

    weights: dict[str, tuple[float, ...]]
    facts: dict[str, str] = field(default_factory=dict)


def write_confidence(path: Path, record: ConfidenceRecord) -> None:
    """Writes JSON beside its place and renames it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps({"schema": SCHEMA, **asdict(record)}, indent=2) + "\n", encoding="utf-8")
    beside.replace(path)


def read_confidence(path: Path) -> ConfidenceRecord:
    """Reads what `write_confidence` wrote.

    Raises:
        FormatError: missing, or another file.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        weights = {str(name): tuple(float(value) for value in numbers) for name, numbers in data["weights"].items()}
        facts = {str(name): str(value) for name, value in data["facts"].items()}
        fits = data["schema"] == SCHEMA and all(np.isfinite(numbers).all() for numbers in weights.values())
    except OSError as error:
        raise FormatError(
            f"{path} cannot be read ({error.strerror}), expected a file of `edge confidence`; check the path"
        ) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        fits = False
    if not fits:
        raise FormatError(f"{path} holds no confidence, expected a file of `edge confidence`; learn it anew")
    return ConfidenceRecord(weights, facts)
