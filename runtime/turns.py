"""Times models against each other on the same frames, so that the comparison holds on a busy machine, too.

All models are loaded at once and take turns frame by frame, the first one changing each time, so that whatever else the
machine does hits all of them alike. A ratio is the median over pairs of neighbouring runs, which a slow spell cannot
shift. Start-up is from opening the directory to the first result; memory is what loading and that result added to the
process.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import Manifest
from runtime.contracts.objects import Detections3D
from runtime.detector import STAGES, Detector, open_detector

TOTAL = "total"
WARM_UP_RUNS = 1
"""After the first run, which counts as start-up; from the second one on times stay as they are."""
_PROC_STATM = Path("/proc/self/statm")
_MEBI = 1 << 20

_log = logging.getLogger(__name__)


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
        stages: ``preprocess``, ``inference``, ``decode``, ``refine`` and ``total``.
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


class Turns:
    """Models loaded at once that look at each frame in turn; a context manager."""

    def __init__(
        self,
        paths: Sequence[Path | str],
        first: StereoFrame,
        *,
        threads: int | None = None,
        use_native: bool = True,
        allow_other_rig: bool = False,
        warn: Callable[[str], None] = _log.warning,
    ) -> None:
        """Loads the models and warms them up.

        Args:
            paths: Model directories; the first is what the ratios refer to.
            first: The frame that they warm up with.
            threads: Of one operator; None leaves it to ONNX Runtime.
            use_native: Whether to take the native library.
            allow_other_rig: Accept cameras far from those of the training data.
            warn: Is told, once a model, that a camera differs.

        Raises:
            ManifestError, SessionError, FrameError, RigError: A model or the frame is unusable.
        """
        with ExitStack() as stack:
            self._loaded = [
                _load(
                    stack,
                    first,
                    path=path,
                    threads=threads,
                    use_native=use_native,
                    allow_other_rig=allow_other_rig,
                    warn=warn,
                )
                for path in paths
            ]
            for item in self._loaded:
                for _ in range(WARM_UP_RUNS):
                    item.detector(first)
            self._stack = stack.pop_all()

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Frees the models."""
        self._stack.close()

    @property
    def manifests(self) -> list[Manifest]:
        """What each model says of itself, in order."""
        return [item.detector.manifest for item in self._loaded]

    @property
    def totals_ms(self) -> list[list[float]]:
        """What each run took, by model and frame."""
        return [[run[TOTAL] for run in item.runs_ms] for item in self._loaded]

    def __call__(self, frame: StereoFrame, *, evaluate: bool = False) -> list[Detections3D]:
        """All models on one frame; what is timed goes from each one's display score on, as a stream does.

        Args:
            frame: A camera pair.
            evaluate: Whether to give the boxes from the evaluation score on.

        Returns:
            The boxes of each model, in order.

        Raises:
            FrameError, RigError, SessionError: The frame or a model is unusable.
        """
        count = len(self._loaded)
        turn = len(self._loaded[0].runs_ms) % count
        found: dict[int, Detections3D] = {}
        for place in (*range(turn, count), *range(turn)):
            item = self._loaded[place]
            thresholds = item.detector.manifest.thresholds
            scores = (thresholds.display, thresholds.evaluate) if evaluate else (thresholds.display,)
            detections, stages_ms = item.detector.at_scores(frame, scores)
            item.runs_ms.append({**stages_ms, TOTAL: sum(stages_ms.values())})
            found[place] = detections[-1]
        return [found[place] for place in range(count)]

    def records(self) -> list[ModelBench]:
        """The figures of all runs so far, one record a model, in order."""
        return [_record(item, self._loaded[0]) for item in self._loaded]


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
    frame: StereoFrame,
    *,
    path: Path | str,
    threads: int | None,
    use_native: bool,
    allow_other_rig: bool,
    warn: Callable[[str], None],
) -> _Loaded:
    before_mib = resident_mib()
    began_secs = time.perf_counter()
    detector = stack.enter_context(
        open_detector(path, threads=threads, use_native=use_native, allow_other_rig=allow_other_rig, warn=warn)
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
