"""Finds objects in frames without labels: by the float model itself."""

from __future__ import annotations

import hashlib
from typing import Protocol

from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import ModelDirectory, format_manifest
from runtime.contracts.objects import Detections3D
from runtime.detector import Detector, open_detector


class Finder(Protocol):
    """Finds objects in a frame.

    Attributes:
        identity: All that the findings depend on beside the frame.
    """

    identity: str

    def __call__(self, frame: StereoFrame) -> Detections3D: ...


class ModelFinder:
    """The float model as a `Finder`; loaded when the first frame comes, since remembered frames need it not."""

    def __init__(self, directory: ModelDirectory, *, allow_other_rig: bool = False) -> None:
        """Names the model: by its manifest, which holds its hashes and thresholds."""
        self.identity = hashlib.sha256(format_manifest(directory.manifest).encode()).hexdigest()
        self._directory = directory
        self._allow_other_rig = allow_other_rig
        self._detector: Detector | None = None

    def __call__(self, frame: StereoFrame) -> Detections3D:
        """Objects of at least the score that a user is shown.

        Raises:
            FrameError: The frame lacks a view, or is too small.
            RigError: Its camera is too far from those of the training data.
        """
        if self._detector is None:
            self._detector = open_detector(
                self._directory, allow_other_rig=self._allow_other_rig, warn=lambda line: None
            )
        return self._detector(frame, score=self._directory.manifest.thresholds.display)[0]

    def close(self) -> None:
        """Frees the model."""
        if self._detector is not None:
            self._detector.session.close()
