"""A model directory as one callable: a frame goes in, 3D boxes and the time of each stage come out."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from runtime.boxcode import FloatArray32
from runtime.contracts.errors import SessionError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.manifest import Manifest, ModelDirectory, open_model_directory
from runtime.contracts.objects import Detections3D
from runtime.preprocess import NetworkView, network_view, prepare
from runtime.readout import Readout
from runtime.refinement import Refined
from runtime.rig import check_rig
from runtime.session import Session, open_session

OUTPUTS = ("cls_logits", "box_deltas")
DELTAS = 12
STAGES = ("preprocess", "inference", "decode", "refine")

_log = logging.getLogger(__name__)


class Detector:
    """One loaded model; a context manager.

    Attributes:
        directory: the model directory.
        session: the loaded graph.
    """

    def __init__(
        self,
        directory: ModelDirectory,
        session: Session,
        *,
        allow_other_rig: bool = False,
        warn: Callable[[str], None] = _log.warning,
    ) -> None:
        """Takes a verified directory and its session.

        Args:
            directory: manifest and priors.
            session: of its graph.
            allow_other_rig: accept cameras far from those of the training data.
            warn: is told, once, that a camera differs.
        """
        self.directory = directory
        self.session = session
        self._readout = Readout(directory.manifest, directory.priors, use_native=session.native_loaded)
        self._allow_other_rig = allow_other_rig
        self._warn = warn
        self._warned = False
        self._view: NetworkView | None = None

    @property
    def manifest(self) -> Manifest:
        """What the model says of itself."""
        return self.directory.manifest

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Frees the model."""
        self.session.close()

    def __call__(self, frame: StereoFrame, *, score: float | None = None) -> tuple[Detections3D, dict[str, float]]:
        """Finds the objects of a frame.

        Args:
            frame: a camera pair.
            score: least score; None takes the manifest's ``evaluate``.

        Returns:
            The boxes, and milliseconds by stage (`STAGES`).

        Raises:
            FrameError: the frame lacks a view, or its image is too small.
            RigError: its camera is too far from those of the training data.
            SessionError: the graph does not fit the manifest.
        """
        (detections,), stages_ms = self.at_scores(frame, (score,))
        return detections, stages_ms

    def at_scores(
        self, frame: StereoFrame, scores: Sequence[float | None]
    ) -> tuple[list[Detections3D], dict[str, float]]:
        """The boxes of a frame from each of several least scores on, by one run of the network.

        The times are those that the first score takes, as if it alone were asked for.

        Raises:
            FrameError, RigError, SessionError: as when called.
        """
        began = time.perf_counter()
        view = self.view(frame.geometry)
        feeds = prepare(frame, view, self.manifest)
        prepared = time.perf_counter()
        cls_logits, box_deltas = self._run(feeds)
        inferred = time.perf_counter()
        found, ends = [], []
        for score in scores:
            detections = self._readout.decode(cls_logits, box_deltas, view, score=score)
            decoded = time.perf_counter()
            found.append(self._readout.refine(detections, frame, score=score))
            ends.append((decoded, time.perf_counter()))
        decoded, refined = ends[0]
        times = (prepared - began, inferred - prepared, decoded - inferred, refined - decoded)
        return found, {stage: 1e3 * secs for stage, secs in zip(STAGES, times, strict=True)}

    def look(self, frame: StereoFrame) -> Refined:
        """The boxes of a frame from the manifest's ``evaluate`` score on, with the network's scores, and what was
        learned of their depths.

        Raises:
            FrameError, RigError, SessionError: as when called.
        """
        view = self.view(frame.geometry)
        outputs = self._run(prepare(frame, view, self.manifest))
        return self._readout.look(self._readout.decode(*outputs, view), frame)

    def view(self, geometry: StereoGeometry) -> NetworkView:
        """How the model sees this camera; checked against the model's rig when the camera changes.

        Raises:
            RigError: the camera is too far from those of the training data.
        """
        known = self._view
        if known is not None and known.camera_geometry is geometry:
            return known
        view = network_view(geometry, self.manifest)
        warning = check_rig(
            view.geometry, self.manifest.rig, stereo=self.manifest.views == 2, allow=self._allow_other_rig
        )
        if warning is not None and not self._warned:
            self._warned = True
            self._warn(warning)
        self._view = view
        return view

    def _run(self, feeds: dict[str, NDArray[np.generic]]) -> tuple[FloatArray32, FloatArray32]:
        cls_logits, box_deltas = self.session.run(feeds, outputs=OUTPUTS)
        rows, columns = (side // self.manifest.anchors.stride_px for side in self.manifest.input_size_hw)
        anchors = rows * columns * self.manifest.anchors.per_cell
        expected = (1, anchors, len(self.manifest.classes) + 1), (1, anchors, DELTAS)
        if (cls_logits.shape, box_deltas.shape) != expected:
            raise SessionError(
                f"{self.directory.model_path}: outputs are {cls_logits.shape} and {box_deltas.shape}, "
                f"expected {expected[0]} and {expected[1]} by the manifest; export the model again"
            )
        return cls_logits, box_deltas


def open_detector(
    path: ModelDirectory | Path | str,
    *,
    threads: int | None = None,
    use_native: bool = True,
    allow_other_rig: bool = False,
    warn: Callable[[str], None] = _log.warning,
) -> Detector:
    """Verifies a model directory and loads it.

    Args:
        path: model directory, or one that was verified already.
        threads: of one operator; None leaves it to ONNX Runtime.
        use_native: take the native library where it was built.
        allow_other_rig: accept cameras far from those of the training data.
        warn: is told, once, that a camera differs.

    Raises:
        ManifestError: the directory is incomplete, altered or of another schema.
        SessionError: the graph cannot be loaded.
    """
    directory = path if isinstance(path, ModelDirectory) else open_model_directory(path)
    session = open_session(directory.model_path, threads=threads, use_native=use_native)
    return Detector(directory, session, allow_other_rig=allow_other_rig, warn=warn)
