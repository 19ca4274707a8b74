"""Remembers observations, so that the same model and frames are not run twice.

A file is named by the hash of all that the observation depends on. What is kept are histograms, from which
every range method follows, so a change of method needs no new run. Files lie in the user's cache folder
(``$XDG_CACHE_HOME/stereo-edge`` or ``~/.cache/stereo-edge``), are written beside their place and renamed,
and hold plain arrays: an unreadable one counts as absent.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from calib.observers import TensorStatistics
from calib.ranges import Observation

_LAYOUT = "observation-1"
_KEPT_FILES = 32


def cache_folder() -> Path:
    """Where observations are kept."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "stereo-edge" / "calibration"


def cache_key(
    model_bytes: bytes,
    frames_digest: str,
    *,
    geometry_digest: str,
    tensors: Sequence[str],
    channel_tensors: Sequence[str],
    view: str,
) -> str:
    """Hash of all that an observation depends on.

    Args:
        model_bytes: The float model.
        frames_digest: Hash of the calibration frames' pixels.
        geometry_digest: Hash of these frames' P2, P3 and sizes: they decide which rows are fed, and how scaled.
        tensors: Observed tensors.
        channel_tensors: Tensors observed by channel.
        view: How frames become feeds (crop, size, normalisation), as text.
    """
    digest = hashlib.sha256(_LAYOUT.encode())
    for part in (
        hashlib.sha256(model_bytes).hexdigest(),
        frames_digest,
        geometry_digest,
        "\n".join(tensors),
        "\n".join(channel_tensors),
        view,
    ):
        digest.update(b"\0" + part.encode())
    return digest.hexdigest()


UNREADABLE = (OSError, KeyError, ValueError, IndexError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
"""What reading a damaged archive of arrays may raise."""


def load(key: str, folder: Path | None = None) -> Observation | None:
    """The observation of this key, or None where there is none or its file is damaged."""
    path = (folder or cache_folder()) / f"{key}.npz"
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            names = [str(name) for name in archive["names"]]
            numbers, counts = archive["numbers"], archive["counts"]
            channel_names = [str(name) for name in archive["channel_names"]]
            channels = {
                name: (archive[f"low_{index}"], archive[f"high_{index}"]) for index, name in enumerate(channel_names)
            }
            tensors = {
                name: TensorStatistics(
                    minimum=float(numbers[index, 0]),
                    maximum=float(numbers[index, 1]),
                    counts=counts[index],
                    first_edge=float(numbers[index, 2]),
                    bin_width=float(numbers[index, 3]),
                )
                for index, name in enumerate(names)
            }
            return Observation(tensors, channels, int(archive["frames"]))
    except UNREADABLE:
        return None


def store(key: str, observation: Observation, folder: Path | None = None) -> Path | None:
    """Keeps an observation; returns its file, or None where the folder cannot be written."""
    target = (folder or cache_folder()) / f"{key}.npz"
    names = list(observation.tensors)
    statistics = [observation.tensors[name] for name in names]
    arrays: dict[str, NDArray[Any]] = {
        "names": np.array(names, dtype=np.str_),
        "numbers": np.array(
            [[item.minimum, item.maximum, item.first_edge, item.bin_width] for item in statistics], np.float64
        ),
        "counts": np.array([item.counts for item in statistics], np.int64),
        "channel_names": np.array(list(observation.channels), dtype=np.str_),
        "frames": np.array(observation.frames),
    }
    for index, (low, high) in enumerate(observation.channels.values()):
        arrays[f"low_{index}"], arrays[f"high_{index}"] = low, high
    return target if write_arrays(target, arrays) else None


def write_arrays(target: Path, arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Writes arrays beside their place and renames; forgets the oldest files there; False where it cannot write."""
    beside: Path | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=target.parent, suffix=".tmp", delete=False) as stream:
            beside = Path(stream.name)
            np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]
        beside.replace(target)
        _forget_oldest(target.parent)
    except OSError:
        return False
    finally:  # a full disk, or Ctrl-C
        if beside is not None:
            with suppress(OSError):
                beside.unlink(missing_ok=True)
    return True


def _forget_oldest(folder: Path) -> None:
    kept = sorted(folder.glob("*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in kept[_KEPT_FILES:]:
        path.unlink(missing_ok=True)
