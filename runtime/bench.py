"""Times models against each other on frames in memory; the profile of one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from runtime.contracts.errors import SessionError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import open_model_directory
from runtime.preprocess import network_view, prepare
from runtime.profile import NodeTime, profile_model
from runtime.turns import ModelBench, Turns


def bench_models(
    paths: Sequence[Path | str],
    frames: Sequence[StereoFrame],
    *,
    repeat: int = 3,
    threads: int | None = None,
    use_native: bool = True,
    allow_other_rig: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[ModelBench]:
    """Times models, boxes from their display score on, as a stream runs them.

    Args:
        paths: Model directories; the first is what the ratios refer to.
        frames: Camera pairs, all in memory.
        repeat: How often each frame is looked at.
        threads: Of one operator; None leaves it to ONNX Runtime.
        use_native: Whether to take the native library.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told how many rounds are done, and how many there are.

    Returns:
        One record a model, in order.

    Raises:
        SourceError: There are no frames.
        SessionError: ``repeat`` is below 1, or no model is named.
        ManifestError, FrameError, RigError: A model or frame is unusable.
    """
    if not frames:
        raise SourceError("bench: found no frames; expected one or more; give a --source with frames")
    if repeat < 1 or not paths:
        raise SessionError(
            f"bench: found {len(paths)} models and repeat {repeat}; expected 1 or more of both; name a model"
        )
    rounds = [frame for _ in range(repeat) for frame in frames]
    with Turns(paths, frames[0], threads=threads, use_native=use_native, allow_other_rig=allow_other_rig) as look:
        for number, frame in enumerate(rounds):
            look(frame)
            progress(number + 1, len(rounds))
        return look.records()


def profile_directory(
    path: Path | str, frames: Sequence[StereoFrame], *, threads: int | None = None, use_native: bool = True
) -> list[NodeTime]:
    """Time of each node of a model directory's optimised graph.

    Raises:
        EdgeError: As `bench_models`.
    """
    directory = open_model_directory(path)
    manifest = directory.manifest
    feeds = [prepare(frame, network_view(frame.geometry, manifest), manifest) for frame in frames]
    return profile_model(directory.model_path, feeds, threads=threads, use_native=use_native)
