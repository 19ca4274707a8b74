"""Runs a model over all frames of a source and keeps what it found."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Self

from runtime.contracts.errors import SourceError
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.detector import STAGES, open_detector
from runtime.pipeline import run_stream
from runtime.sinks.base import FrameResult
from runtime.sources.base import Source, as_sequence

READ, TOTAL = "read", "total"


@dataclass(frozen=True, slots=True)
class ModelRun:
    """One model's detections on all frames of a source.

    Attributes:
        path: model directory, as it was given.
        classes: what the model can tell apart.
        score_display: threshold for agreement and pictures; detections reach down to the model's evaluation
            score.
        frame_ids: names of the frames; labels: of each frame, None where it has none; detections: of each
            frame.
        latency_ms: stage to the median milliseconds a frame.
    """

    path: str
    classes: tuple[str, ...]
    score_display: float
    frame_ids: tuple[str, ...]
    labels: tuple[Objects3D | None, ...]
    detections: tuple[Detections3D, ...]
    latency_ms: dict[str, float]


@dataclass(slots=True)
class _Collector:
    """A sink that keeps results, not images."""

    frame_ids: list[str] = field(default_factory=list)
    labels: list[Objects3D | None] = field(default_factory=list)
    detections: list[Detections3D] = field(default_factory=list)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def write(self, result: FrameResult) -> None:
        self.frame_ids.append(result.frame.frame_id)
        self.labels.append(result.labels)
        self.detections.append(result.detections)

    def summary(self) -> str:
        return f"{len(self.frame_ids)} frames kept"


def run_model(
    model_path: Path | str,
    source: Source,
    *,
    on_frame: Callable[[], None] | None = None,
    allow_other_rig: bool = False,
    warn: Callable[[str], None] | None = None,
) -> ModelRun:
    """Detect in every frame of an entered, recorded source, down to the model's evaluation score.

    Args:
        model_path: model directory.
        source: file-backed frames; it may be run over again for the next model.
        on_frame: called after each frame, for progress.
        allow_other_rig: accept cameras far from those of the training data.
        warn: is told, once, that a camera differs.

    Raises:
        ManifestError: the model directory is incomplete or altered.
        SessionError: the graph cannot be loaded or run.
        SourceError: the source is live, or has no frame.
        FrameError, RigError: a frame is unusable for the model.
    """
    frames = as_sequence(source)
    kept = _Collector()
    options = {} if warn is None else {"warn": warn}
    with open_detector(model_path, allow_other_rig=allow_other_rig, **options) as detector:
        report = run_stream(
            frames,
            detector,
            [kept],
            with_labels=True,
            on_result=None if on_frame is None else lambda result: on_frame(),
        )
        manifest = detector.manifest
    if report.interrupted:
        raise KeyboardInterrupt
    if not kept.frame_ids:
        raise SourceError(f"{source.uri} holds no frame, expected at least one; check its path and options")
    medians = {stage: item.p50 for stage, item in report.latency.summary().items()}
    return ModelRun(
        path=str(model_path),
        classes=manifest.classes,
        score_display=manifest.thresholds.display,
        frame_ids=tuple(kept.frame_ids),
        labels=tuple(kept.labels),
        detections=tuple(kept.detections),
        latency_ms={stage: medians[stage] for stage in (READ, *STAGES, TOTAL) if stage in medians},
    )
