"""NNCF on our graph: the correlation inlined, our frames as its data set, agreement with FP32 as its accuracy."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import onnx
from onnx.inliner import inline_local_functions

os.environ.setdefault("NNCF_CI", "1")  # read at import: no telemetry
import nncf

from calib.frames import frame_feeds
from edge.evaluation.agreement import agreement
from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Detections3D
from runtime.detector import open_detector
from tests.benchmarks.quantisers_job import Feeds, Job, write_peer

PER_CENT = 100.0


@dataclass(frozen=True, slots=True)
class Item:
    """One control frame: its place among them, the camera pair, and the graph's inputs made of it."""

    row: int
    frame: StereoFrame
    feed: Feeds


def float_graph(job: Job) -> onnx.ModelProto:
    """The float model in standard operators alone: NNCF runs intermediate graphs without their function bodies."""
    return inline_local_functions(onnx.load(job.model.model_path))


def quantised(job: Job, *, fast: bool) -> onnx.ModelProto:
    """Plain post-training quantisation.

    Args:
        job: Model and frames.
        fast: Correct biases layer by layer from statistics of one run (NNCF's default), or in sequence.
    """
    feeds = job.feeds()
    return nncf.quantize(
        float_graph(job),
        nncf.Dataset(feeds),
        preset=nncf.QuantizationPreset.MIXED,
        subset_size=len(feeds),
        fast_bias_correction=fast,
    )


def quantised_with_control(job: Job) -> onnx.ModelProto:
    """Quantisation that gives layers back to float until the control frames' detections agree with FP32's."""
    feeds, frames, control = job.feeds(), job.control_frames(), job.control
    control_feeds = frame_feeds(frames, job.model.manifest)
    items = [Item(row, frame, feed) for row, (frame, feed) in enumerate(zip(frames, control_feeds, strict=True))]
    reference = _look(job.model.path, items)
    display = job.model.manifest.thresholds.display

    def accuracy(model: onnx.ModelProto, chosen: Iterable[Item]) -> tuple[float, list[float]]:
        """Matched share, from 0 to 1, of all and of each frame: by the latter NNCF ranks layers of ONNX graphs."""
        rows = list(chosen)
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "candidate"
            write_peer(job.model, place, recipe="candidate", write_graph=lambda at: onnx.save(model, at))
            found = _look(place, rows)
        shares = [_share([reference[item.row]], [seen], display) for item, seen in zip(rows, found, strict=True)]
        return _share([reference[item.row] for item in rows], found, display), shares

    return nncf.quantize_with_accuracy_control(
        float_graph(job),
        calibration_dataset=nncf.Dataset(feeds),
        validation_dataset=nncf.Dataset(items, lambda item: item.feed),
        validation_fn=accuracy,
        max_drop=control.max_disagreement / PER_CENT,
        drop_type=nncf.DropType.ABSOLUTE,
        preset=nncf.QuantizationPreset.MIXED,
        subset_size=len(feeds),
        advanced_accuracy_restorer_parameters=nncf.AdvancedAccuracyRestorerParameters(
            max_num_iterations=control.max_layers, ranking_subset_size=control.ranking_frames
        ),
    )


def _look(place: Path, items: Iterable[Item]) -> list[Detections3D]:
    """What a model finds in each frame."""
    with open_detector(place) as detector:
        return [detector(item.frame)[0] for item in items]


def _share(reference: Sequence[Detections3D], found: Sequence[Detections3D], display: float) -> float:
    return agreement(reference, found, reference_score=display, other_score=display).matched_share
