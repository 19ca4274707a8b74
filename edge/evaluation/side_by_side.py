"""Runs models over the same frames in turn: what each found, and times that can be compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from edge.evaluation.run import READ, ModelRun
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.detector import STAGES
from runtime.pipeline import FrameReader
from runtime.sources.base import Source, as_sequence
from runtime.turns import TOTAL, ModelBench, Turns


def run_side_by_side(
    paths: Sequence[Path | str],
    source: Source,
    *,
    on_frame: Callable[[], None] = lambda: None,
    allow_other_rig: bool = False,
    warn: Callable[[str], None],
) -> tuple[list[ModelRun], list[ModelBench]]:
    """Detects in every frame of an entered, recorded source, down to each model's evaluation score.

    All models are in memory at once and see a frame one after another, while the next one is read. Times are of boxes
    from the display score on; the total begins with reading.

    Args:
        paths: model directories; ratios of the times refer to the first.
        source: file-backed frames.
        on_frame: called after each frame, for progress.
        allow_other_rig: accept cameras far from those of the training data.
        warn: is told, once a model, that a camera differs.

    Returns:
        Of each model, in order, what it found and how long it took.

    Raises:
        ManifestError: a model directory is incomplete or altered.
        SessionError: a graph cannot be loaded or run.
        SourceError: the source is live.
        FrameError, RigError: a frame is unusable for a model.
    """
    frames = as_sequence(source)
    frame_ids: list[str] = []
    labels: list[Objects3D | None] = []
    read_ms: list[float] = []
    found: list[list[Detections3D]] = []
    with Turns(paths, frames[0], allow_other_rig=allow_other_rig, warn=warn) as look:
        with FrameReader(frames, with_labels=True) as reader:
            for item in reader:
                found.append(look(item.frame, evaluate=True))
                frame_ids.append(item.frame.frame_id)
                labels.append(item.labels)
                read_ms.append(item.read_ms)
                on_frame()
        benches, manifests = look.records(), look.manifests
        total_ms = np.array(look.totals_ms) + np.array(read_ms)
    runs = []
    for number, (bench, manifest) in enumerate(zip(benches, manifests, strict=True)):
        medians = {stage: bench.stages[stage].median for stage in STAGES}
        runs.append(
            ModelRun(
                path=bench.path,
                classes=manifest.classes,
                score_display=manifest.thresholds.display,
                frame_ids=tuple(frame_ids),
                labels=tuple(labels),
                detections=tuple(boxes[number] for boxes in found),
                latency_ms={READ: float(np.median(read_ms)), **medians, TOTAL: float(np.median(total_ms[number]))},
            )
        )
    return runs, benches
