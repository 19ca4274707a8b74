"""The anchor priors that belong to a checkpoint."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edge.detector.presets import Preset
from runtime.contracts.errors import CheckpointError
from runtime.contracts.manifest import PRIORS_FILE, AnchorPriors, read_priors

OFFICIAL_CLASS_ORDER = ("Car", "Pedestrian", "Cyclist")
"""Order of the class channels in the official code's configurations."""
_MEAN_PREFIX = "anchor_mean_"


def find_priors(preset: Preset, checkpoint: Path, given: Path | None) -> AnchorPriors:
    """Reads priors in any form that they come in.

    Args:
        preset: Whose classes and anchors they must fit.
        checkpoint: Weights; ``priors.npz`` in the same folder is taken where nothing was given.
        given: An ``.npz`` of ``edge priors``, a folder with ``priors.npz``, or a folder of the official
            code's ``anchor_mean_CLASS.npy`` and ``anchor_std_CLASS.npy``, itself or the one above ``training``.

    Raises:
        CheckpointError: There are none.
        ManifestError: They do not fit the preset.
    """
    where = given if given is not None else checkpoint.parent
    if where.is_file():
        return read_priors(where, preset.classes, preset.anchors)
    if (where / PRIORS_FILE).is_file():
        return read_priors(where / PRIORS_FILE, preset.classes, preset.anchors)
    official = _official_folder(where)
    if official is not None:
        return _read_official(preset, official)
    raise CheckpointError(
        f"{where}: found no anchor priors; expected {PRIORS_FILE} or the official anchor_mean_CLASS.npy files;"
        " make them with `edge priors` and give them by --priors"
    )


def official_classes(folder: Path) -> tuple[str, ...]:
    """Classes that a folder holds official tables of, in KITTI's order; none where it holds none."""
    official = _official_folder(folder)
    if official is None:
        return ()
    found = {path.stem.removeprefix(_MEAN_PREFIX) for path in official.glob(f"{_MEAN_PREFIX}*.npy")}
    order = {name: rank for rank, name in enumerate(OFFICIAL_CLASS_ORDER)}
    return tuple(sorted(found, key=lambda name: (order.get(name, len(order)), name)))


def _official_folder(folder: Path) -> Path | None:
    """Where the tables lie: the official code writes them into ``training`` below its folder of prepared data."""
    places = (folder, folder / "training")
    return next((place for place in places if any(place.glob(f"{_MEAN_PREFIX}*.npy"))), None)


def _read_official(preset: Preset, folder: Path) -> AnchorPriors:
    layout = preset.anchors
    shape = (layout.scale_count, len(layout.ratios), 6)
    parts = []
    for part in ("mean", "std"):
        tables = []
        for name in preset.classes:
            path = folder / _official_name(part, name)
            try:
                table = np.load(path, allow_pickle=False)
            except (OSError, ValueError, EOFError) as error:
                raise CheckpointError(
                    f"{path}: found that it cannot be read ({type(error).__name__}); expected a plain .npy table"
                    " for each class; copy it again or use `edge priors`"
                ) from error
            if table.shape != shape or table.dtype.kind != "f":
                raise CheckpointError(
                    f"{path}: found shape {table.shape} of {table.dtype}; expected {shape} of floats; use the priors"
                    " of this --preset"
                )
            tables.append(table.astype(np.float32))
        parts.append(np.stack(tables))
    return AnchorPriors(mean=parts[0], std=parts[1])


def _official_name(part: str, class_name: str) -> str:
    return f"anchor_{part}_{class_name}.npy"
