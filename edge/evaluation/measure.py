"""Measures a model on a source: AP where there are labels, agreement with a reference model, latency.

`measure` is what a budget search calls; `assess` and `measurement` are its two halves, for callers that
compare many models with one reference.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path

from edge.evaluation.agreement import agreement
from edge.evaluation.bootstrap import ApDraws, ap_drop, ap_interval95, frame_weights
from edge.evaluation.kitti_ap import Evaluation, evaluate
from edge.evaluation.run import ModelRun, run_model
from runtime.contracts.errors import FormatError
from runtime.contracts.measurement import Measurement
from runtime.sources.base import Source
from runtime.sources.factory import open_source


@dataclass(frozen=True, slots=True)
class Assessment:
    """A run with its matches to the labels.

    Attributes:
        run: the detections.
        evaluation: matches on the labelled frames, None where no frame has labels.
        draws: AP of each bootstrap draw; empty without labels.
    """

    run: ModelRun
    evaluation: Evaluation | None
    draws: ApDraws


def labelled_frames(run: ModelRun) -> list[int]:
    """Indices of the frames that have labels."""
    return [index for index, labels in enumerate(run.labels) if labels is not None]


def assess(run: ModelRun) -> Assessment:
    """Match a run with the labels of its frames; frames without labels are left out of AP."""
    rows = labelled_frames(run)
    if not rows:
        return Assessment(run, None, {})
    labels = [item for item in run.labels if item is not None]
    evaluation = evaluate(labels, [run.detections[index] for index in rows], run.classes)
    return Assessment(run, evaluation, evaluation.draws(frame_weights(evaluation.frames)))


def measurement(assessment: Assessment, reference: Assessment | None = None) -> Measurement:
    """The record of an assessed run, compared with a reference run on the same frames.

    Args:
        assessment: the model.
        reference: the model to compare with; None for the reference itself.

    Raises:
        FormatError: the two ran on different frames.
    """
    run, evaluation = assessment.run, assessment.evaluation
    compared, drop, drop_interval95 = None, {}, {}
    if reference is not None:
        if reference.run.frame_ids != run.frame_ids:
            raise FormatError(
                f"{reference.run.path} ran on {len(reference.run.frame_ids)} frames and {run.path} on other "
                f"{len(run.frame_ids)}, expected the same frames; run both on one source"
            )
        compared = agreement(
            reference.run.detections,
            run.detections,
            reference_score=reference.run.score_display,
            other_score=run.score_display,
        )
        if evaluation is not None and reference.evaluation is not None:
            lost = ap_drop(
                reference.evaluation, evaluation, reference_draws=reference.draws, other_draws=assessment.draws
            )
            drop, drop_interval95 = lost.points, lost.interval95
    return Measurement(
        path=run.path,
        ap={} if evaluation is None else evaluation.ap(),
        frames=len(run.frame_ids),
        objects={} if evaluation is None else evaluation.objects,
        latency_ms=run.latency_ms,
        agreement=compared,
        ap_interval95={} if evaluation is None else ap_interval95(evaluation, assessment.draws),
        drop=drop,
        drop_interval95=drop_interval95,
    )


def measure(
    model_path: Path | str,
    source: Source | str,
    reference: Assessment | None = None,
    *,
    allow_other_rig: bool = False,
    warn: Callable[[str], None] | None = None,
) -> Measurement:
    """Run a model over a source and measure it.

    Args:
        model_path: model directory.
        source: an entered source, or the URI of one.
        reference: what to compare with, from ``assess(run_model(...))`` on the same source.
        allow_other_rig: accept cameras far from those of the training data.
        warn: is told, once, that a camera differs.

    Raises:
        EdgeError: as `run_model` and `measurement`.
    """
    with open_source(source) if isinstance(source, str) else nullcontext(source) as frames:
        run = run_model(model_path, frames, allow_other_rig=allow_other_rig, warn=warn)
    return measurement(assess(run), reference)
