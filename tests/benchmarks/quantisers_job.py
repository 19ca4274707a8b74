"""What every quantiser is handed, and the model directory that it hands back."""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from calib.frames import frame_feeds
from runtime.contracts.errors import SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    ModelDirectory,
    file_sha256,
    format_manifest,
    open_model_directory,
)
from runtime.model_folder import replaced_directory
from runtime.sources.factory import open_sequence
from runtime.sources.uri import parse_uri

Feeds = dict[str, NDArray[Any]]


@dataclass(frozen=True, slots=True)
class Control:
    """What accuracy control may look at: never the frames that measure.

    Attributes:
        uri: source of exactly the frames.
        max_disagreement: budget, per cent of detections that may differ from the float model's.
        ranking_frames: how many of them rank layers.
        max_layers: how many groups of layers NNCF may give back at most.
    """

    uri: str
    max_disagreement: float
    ranking_frames: int
    max_layers: int


@dataclass(frozen=True, slots=True)
class Job:
    """One float model and the frames to quantise it on.

    Attributes:
        model: float model directory.
        calibration: source of exactly the calibration frames, which all of them are used.
        frames: how many those are.
        control: for those with accuracy control.
    """

    model: ModelDirectory
    calibration: str
    frames: int
    control: Control

    def feeds(self) -> list[Feeds]:
        """The graph's inputs of every calibration frame, preprocessed by the runtime for this model."""
        with open_sequence(self.calibration) as source:
            return list(frame_feeds((source[index] for index in range(len(source))), self.model.manifest))

    def control_frames(self) -> list[StereoFrame]:
        """Camera pairs for accuracy control."""
        with open_sequence(self.control.uri) as source:
            return [source[index] for index in range(len(source))]


def narrowed(uri: str, wanted: int, *, shift: int = 0) -> str:
    """A source of exactly ``wanted`` frames at equal steps over another, so that nobody can choose others.

    Args:
        uri: A recording.
        wanted: How many.
        shift: Begin so many parts in eight of a step later: two shifts give different frames where a step is 8 or more.

    Raises:
        SourceError: There are fewer.
    """
    with open_sequence(uri) as source:
        available = len(source)
    if wanted < 1 or available < wanted:
        raise SourceError(f"{uri}: found {available} frames; expected {max(wanted, 1)} or more; ask for fewer")
    parsed, every = parse_uri(uri), available // wanted
    step = int(parsed.options.get("step", 1))
    start = int(parsed.options.get("start", 0)) + shift * every // 8 * step
    options = {**parsed.options, "start": start, "step": step * every, "limit": wanted}
    return f"{parsed.scheme}:{parsed.target}?" + "&".join(f"{name}={value}" for name, value in options.items())


def write_peer(source: ModelDirectory, out: Path, *, recipe: str, write_graph: Callable[[Path], object]) -> None:
    """A model directory that is the float one's but for its graph.

    Args:
        source: The float model.
        out: Place; an older model there is replaced.
        recipe: What the manifest says.
        write_graph: Writes the ONNX file at the path it is given.
    """
    with replaced_directory(out) as folder:
        write_graph(folder / MODEL_FILE)
        shutil.copyfile(source.path / PRIORS_FILE, folder / PRIORS_FILE)
        manifest = dataclasses.replace(
            source.manifest,
            recipe=recipe,
            sha256={name: file_sha256(folder / name) for name in (MODEL_FILE, PRIORS_FILE)},
        )
        (folder / MANIFEST_FILE).write_text(format_manifest(manifest), encoding="utf-8")
    open_model_directory(out)
