"""Validation while training: KITTI AP of the averaged weights on labelled frames, and the best weights kept."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import torch
from torch import nn

from edge.detector.presets import Preset
from edge.detector.weights import save_weights
from edge.evaluation.kitti_ap import Evaluation, evaluate
from edge.training.checkpoint import BEST_FILE
from edge.training.distributed import ALONE, Ranks, gathered, spread
from runtime.contracts.errors import SourceError
from runtime.contracts.manifest import AnchorPriors
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.preprocess import network_view, prepare
from runtime.readout import Readout
from runtime.sources.base import FrameSequence

VALIDATION_FILE = "validation.jsonl"
MODERATE = 1


class Validation:
    """Measures a state of the detector as `edge accuracy` measures its export, in torch.

    Several processes share the frames. The best state is the one of the highest `mean_moderate_ap`, the later of
    equals; it is written as ``best.safetensors``. Each validation adds a line to ``validation.jsonl``.

    Args:
        detector: the network being trained; its shape is copied, its weights are not touched.
        preset: crop, anchors, thresholds.
        priors: of the run.
        frames: labelled frames; those without labels are passed over.
        run_dir: where the files go.
        metadata: of the weights file.
        first_step: lines of later steps, left by an interrupted run, are taken out.
        ranks: this process among those that train.

    Raises:
        SourceError: no frame has labels.
        FrameError: the first one that has them lacks a view, or does not fit the preset.
    """

    def __init__(
        self,
        detector: nn.Module,
        preset: Preset,
        priors: AnchorPriors,
        *,
        frames: FrameSequence,
        run_dir: Path,
        metadata: dict[str, str],
        first_step: int = 0,
        ranks: Ranks = ALONE,
    ) -> None:
        self._detector = copy.deepcopy(detector).eval()
        self._classes = preset.classes
        self._manifest = preset.manifest(input_type="float32")
        self._readout = Readout(self._manifest, priors)
        self._frames = frames
        self._rows = [row for row in range(len(frames)) if frames.labels(row) is not None]
        if not self._rows:
            raise SourceError(f"{frames.uri} holds no labelled frame, expected at least one to validate on")
        frame = frames[self._rows[0]]
        prepare(frame, network_view(frame.geometry, self._manifest), self._manifest)  # tells what does not fit, now
        self._file = run_dir / VALIDATION_FILE
        self._best_file = run_dir / BEST_FILE
        self._metadata = metadata
        self._ranks = ranks
        earlier = self._file.read_text().splitlines() if self._file.exists() else []
        kept = [line for line in earlier if json.loads(line)["step"] <= first_step]
        self._best = max((json.loads(line)["score"] for line in kept), default=-1.0)
        if ranks.writes and len(kept) < len(earlier):
            self._file.write_text("".join(f"{line}\n" for line in kept))

    def __call__(self, state: dict[str, torch.Tensor], step: int) -> dict[str, float]:
        """Measure a state; every process calls this.

        Args:
            state: of the detector; rank 0's counts.
            step: for the log.

        Returns:
            Numbers for the event log, by tag.
        """
        spread(state, self._ranks)
        self._detector.load_state_dict(state)
        self._detector.to(next(iter(state.values())).device)
        own = self._detect(self._rows[self._ranks.rank :: self._ranks.count])
        rows = dict(pair for part in gathered(own, self._ranks) for pair in part.items())
        labels = [_labels(self._frames, row) for row in self._rows]
        evaluation = evaluate(labels, [rows[row] for row in self._rows], self._classes)
        score = mean_moderate_ap(evaluation)
        is_best = score >= self._best
        self._best = max(score, self._best)
        if self._ranks.writes:
            record = {
                "step": step,
                "score": score,
                "frames": evaluation.frames,
                "objects": evaluation.objects,
                "ap": evaluation.ap(),
            }
            with self._file.open("a") as stream:
                stream.write(json.dumps(record) + "\n")
            if is_best:
                told = self._metadata | {"steps": str(step), "validation_score": f"{score:.4f}"}
                save_weights(self._best_file, {name: value.cpu() for name, value in state.items()}, metadata=told)
        return scalars(evaluation)

    def _detect(self, rows: list[int]) -> dict[int, Detections3D]:
        device = next(self._detector.parameters()).device
        found = {}
        for row in rows:
            frame = self._frames[row]
            view = network_view(frame.geometry, self._manifest)
            views = [torch.from_numpy(image).to(device) for image in prepare(frame, view, self._manifest).values()]
            with torch.inference_mode():
                logits, deltas = (np.asarray(output.float().cpu()) for output in self._detector(*views)[:2])
            found[row] = self._readout.refine(self._readout.decode(logits, deltas, view), frame)
        return found


def mean_moderate_ap(evaluation: Evaluation) -> float:
    """Mean over the classes that occur of 3D AP (R40, moderate, strict overlap), per cent; what "best" means."""
    values = [
        levels["R40"][MODERATE]
        for name, overlap, levels in _strict_3d(evaluation)
        if evaluation.objects[name][MODERATE]
    ]
    return float(np.mean(values)) if values else 0.0


def scalars(evaluation: Evaluation) -> dict[str, float]:
    """The score, and 3D AP (R40, strict overlap) by class and difficulty, by tag of the event log."""
    tags = {"validation/score": mean_moderate_ap(evaluation)}
    for name, overlap, levels in _strict_3d(evaluation):
        for difficulty, value in zip(("easy", "moderate", "hard"), levels["R40"], strict=True):
            tags[f"validation/{name}_3d_{overlap}_{difficulty}"] = value
    return tags


def _strict_3d(evaluation: Evaluation) -> list[tuple[str, str, dict[str, list[float]]]]:
    strict = []
    for name, metrics in evaluation.ap().items():
        overlap = max(metrics["3d"], key=float)
        strict.append((name, overlap, metrics["3d"][overlap]))
    return strict


def _labels(frames: FrameSequence, row: int) -> Objects3D:
    labels = frames.labels(row)
    assert labels is not None  # rows are those with labels
    return labels
