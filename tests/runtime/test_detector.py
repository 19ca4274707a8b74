"""A whole model directory as one callable."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.errors import FrameError, RigError, SessionError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import open_model_directory
from runtime.detector import STAGES, Detector, open_detector
from runtime.session import open_session
from runtime.sources.base import as_sequence
from runtime.sources.factory import open_source


@pytest.fixture
def frame(tiny_drive: Path) -> StereoFrame:
    with as_sequence(open_source(f"kitti-object:{tiny_drive}")) as source:
        return source[2]


def with_baseline(frame: StereoFrame, factor: float) -> StereoFrame:
    right = frame.geometry.P3.copy()
    right[0, 3] *= factor
    return dataclasses.replace(frame, geometry=dataclasses.replace(frame.geometry, P3=right))


def test_boxes_in_camera_pixels_and_stage_times(tiny_model: Path, frame: StereoFrame) -> None:
    with open_detector(tiny_model, threads=1) as detector:
        detections, times = detector(frame)
        assert tuple(times) == STAGES
        assert all(value >= 0 for value in times.values())
    assert len(detections) == 1
    box = detections.box_in_left_image[0]
    assert (box >= 0).all()
    assert (box[2:] <= (128, 64)).all()
    assert (box[2] + box[0]) / 2 == pytest.approx(80.0, abs=1e-3)  # third cell's centre, 40 px, at twice the size


def test_score_is_a_threshold(tiny_model: Path, frame: StereoFrame) -> None:
    with open_detector(tiny_model) as detector:
        assert len(detector(frame, score=0.9)[0]) == 1
        assert len(detector(frame, score=0.9999)[0]) == 0


def test_one_view_is_refused(tiny_model: Path, frame: StereoFrame) -> None:
    with open_detector(tiny_model) as detector, pytest.raises(FrameError, match="no right image"):
        detector(dataclasses.replace(frame, right=None))


def test_another_rig_warns_once_and_beyond_is_refused(tiny_model: Path, frame: StereoFrame) -> None:
    told: list[str] = []
    with open_detector(tiny_model, warn=told.append) as detector:
        detector(frame)
        assert told == []
        detector(with_baseline(frame, 1.1))
        detector(with_baseline(frame, 1.15))
        assert len(told) == 1
        assert "baseline" in told[0]
        with pytest.raises(RigError):
            detector(with_baseline(frame, 2.0))
    with open_detector(tiny_model, warn=told.append, allow_other_rig=True) as detector:
        assert len(detector(with_baseline(frame, 2.0))[0]) == 1


def test_outputs_that_do_not_fit_the_manifest(tiny_model: Path, frame: StereoFrame) -> None:
    directory = open_model_directory(tiny_model)
    other = dataclasses.replace(directory.manifest, classes=("Car", "Pedestrian"))
    priors = dataclasses.replace(directory.priors, mean=directory.priors.mean[:2], std=directory.priors.std[:2])
    wrong = dataclasses.replace(directory, manifest=other, priors=priors)
    with Detector(wrong, open_session(wrong.model_path)) as detector, pytest.raises(SessionError, match="expected"):
        detector(frame)


def test_closed_after_the_block(tiny_model: Path, frame: StereoFrame) -> None:
    with open_detector(tiny_model) as detector:
        pass
    with pytest.raises(SessionError, match="closed"):
        detector(frame)


def test_frames_stay_as_they_are(tiny_model: Path, frame: StereoFrame) -> None:
    before = frame.left.copy()
    with open_detector(tiny_model) as detector:
        detector(frame)
    assert np.array_equal(before, frame.left)
