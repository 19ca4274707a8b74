"""The anchor priors that belong to a checkpoint."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

import numpy as np

from edge.detector.presets import PRESETS, Preset
from runtime.contracts.errors import CheckpointError
from runtime.contracts.manifest import PRIORS_FILE, AnchorPriors, read_priors

SHAPE_FIELDS = ("stride_px", "base_px", "scales_per_octave", "scale_count", "ratios")
"""What statistics depend on: anchors of the same shape in the same places."""
OFFICIAL_CLASS_ORDER = ("Car", "Pedestrian", "Cyclist")
"""Order of the class channels in the official code's configurations."""
BUNDLED = {"paper": "paper-priors.npz", "mono": "mono-priors.npz"}
"""Statistics of KITTI's 3,712 train-side label files (CC BY-NC-SA 3.0), by preset."""
BUNDLED_ORIGIN = "bundled statistics of KITTI's 3,712 train-side label files, licence CC BY-NC-SA 3.0"
_MEAN_PREFIX = "anchor_mean_"


def find_priors(preset: Preset, checkpoint: Path, given: Path | None) -> AnchorPriors:
    """Reads priors in any form that they come in.

    Args:
        preset: Whose classes and anchors they must fit.
        checkpoint: Weights; ``priors.npz`` in the same folder is taken where nothing was given.
        given: An ``.npz`` of ``edge priors``, a folder with ``priors.npz``, or a folder of the official
            code's ``anchor_mean_CLASS.npy`` and ``anchor_std_CLASS.npy``, itself or the one above ``training``.
            Where nothing was given and nothing lies beside the checkpoint: those of `bundled_priors`.

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
    bundled = bundled_priors(preset)
    if given is None and bundled is not None:
        return read_priors(bundled, preset.classes, preset.anchors)
    raise CheckpointError(
        f"{where}: found no anchor priors; expected {PRIORS_FILE} or the official anchor_mean_CLASS.npy files;"
        " make them with `edge priors` and give them by --priors"
    )


def uses_bundled_priors(preset: Preset, checkpoint: Path, given: Path | None) -> bool:
    """Whether `find_priors` falls back to the package's own table."""
    beside = (checkpoint.parent / PRIORS_FILE).is_file() or _official_folder(checkpoint.parent) is not None
    return given is None and not beside and bundled_priors(preset) is not None


def bundled_priors(preset: Preset) -> Path | None:
    """The package's own table for a preset, ablated or not; None where there is none for it.

    Classes, anchors, crop and rig must be those that the table was made for: which depth an anchor of some size stands
    for hangs on the focal length that it is seen with. Its licence is KITTI's, CC BY-NC-SA 3.0, which a model that is
    made with it inherits.
    """
    name = preset.name.partition("+")[0]
    if name not in BUNDLED:
        return None
    original = PRESETS[name]
    layout, own = preset.anchors, original.anchors
    same_shapes = all(getattr(layout, part) == getattr(own, part) for part in SHAPE_FIELDS)
    same = same_shapes and preset.classes == original.classes
    same = same and (preset.input_size_hw, preset.crop) == (original.input_size_hw, original.crop)
    same = same and preset.rig == original.rig
    return Path(str(files("edge.zoo"))) / BUNDLED[name] if same else None


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
