"""Times models against each other on the same frames, so that the comparison holds on a busy machine, too.

All models are loaded at once and take turns frame by frame, the first one changing each time, so that whatever else the
machine does hits all of them alike. A ratio is the median over pairs of neighbouring runs, which a slow spell cannot
shift. Start-up is from opening the directory to the first result; memory is what loading and that result added to the
process.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from runtime.contracts.errors import SessionError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import open_model_directory
from runtime.detector import STAGES, Detector, open_detector
from runtime.preprocess import network_view, prepare
from runtime.profile import NodeTime, profile_model

TOTAL = "total"
WARM_UP_RUNS = 2
_PROC_STATM = Path("/proc/self/statm")
_MEBI = 1 << 20


@dataclass(frozen=True, slots=True)
class Spread:
    """Milliseconds over all runs.

    Attributes:
        median: p50; low: p10; high: p90.
    """

    median: float
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class ModelBench:
    """One model's figures.

    Attributes:
        path: model directory as given; recipe: of its manifest.
        stages: ``preprocess``, ``inference``, ``decode`` and ``total``.
        ratio: its total over the first model's, median over pairs of neighbouring runs; 1 for the first.
        runs: timed runs.
        start_up_ms: opening, loading and the first frame.
        memory_mib: resident memory that loading and the first frame added; None where the system does not tell.
        native: whether the native library computed the correlations.
    """

    path: str
    recipe: str
    stages: dict[str, Spread]
    ratio: float
    runs: int
    start_up_ms: float
    memory_mib: float | None
    native: bool


@dataclass(slots=True)
class _Loaded:
    path: str
    detector: Detector
    start_up_ms: float
    memory_mib: float | None
    runs_ms: list[dict[str, float]]


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
        use_native: Whether to take the native correlation library.
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
    with ExitStack() as stack:
        loaded = [
            _load(stack, path, frames[0], threads=threads, use_native=use_native, allow_other_rig=allow_other_rig)
            for path in paths
        ]
        for item in loaded:
            for _ in range(WARM_UP_RUNS):
                item.detector(frames[0])
        rounds = [frame for _ in range(repeat) for frame in frames]
        for number, frame in enumerate(rounds):
            turn = number % len(loaded)
            for item in (*loaded[turn:], *loaded[:turn]):
                _, stages_ms = item.detector(frame, score=item.detector.manifest.thresholds.display)
                item.runs_ms.append({**stages_ms, TOTAL: sum(stages_ms.values())})
            progress(number + 1, len(rounds))
        return [_record(item, loaded[0]) for item in loaded]


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


def spread(samples_ms: Sequence[float]) -> Spread:
    """Median and the middle four fifths of one or more samples."""
    low, median, high = np.percentile(np.asarray(samples_ms, np.float64), (10, 50, 90))
    return Spread(float(median), float(low), float(high))


def resident_mib() -> float | None:
    """Resident memory of this process; None where the system does not tell."""
    try:
        pages = int(_PROC_STATM.read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE") / _MEBI


def _load(
    stack: ExitStack,
    path: Path | str,
    frame: StereoFrame,
    *,
    threads: int | None,
    use_native: bool,
    allow_other_rig: bool,
) -> _Loaded:
    before_mib = resident_mib()
    began_secs = time.perf_counter()
    detector = stack.enter_context(
        open_detector(path, threads=threads, use_native=use_native, allow_other_rig=allow_other_rig)
    )
    detector(frame)
    start_up_ms = 1e3 * (time.perf_counter() - began_secs)
    after_mib = resident_mib()
    grown = None if before_mib is None or after_mib is None else max(after_mib - before_mib, 0.0)
    return _Loaded(str(path), detector, start_up_ms, grown, [])


def _record(item: _Loaded, first: _Loaded) -> ModelBench:
    ratios = [run[TOTAL] / other[TOTAL] for run, other in zip(item.runs_ms, first.runs_ms, strict=True)]
    return ModelBench(
        path=item.path,
        recipe=item.detector.manifest.recipe,
        stages={stage: spread([run[stage] for run in item.runs_ms]) for stage in (*STAGES, TOTAL)},
        ratio=float(np.median(ratios)),
        runs=len(item.runs_ms),
        start_up_ms=item.start_up_ms,
        memory_mib=item.memory_mib,
        native=item.detector.session.native_loaded,
    )
