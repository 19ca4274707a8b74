"""Boxes of a bundled model's outputs: what is asked for must not change what is found."""

from __future__ import annotations

from dataclasses import replace
from importlib.resources import files

import numpy as np

from edge.samples import measuring_source
from runtime.detector import Detector, open_detector
from runtime.refinement import FEATURES
from runtime.sources.base import as_sequence
from runtime.sources.factory import open_source

FRAMES_WITH_HIDERS = (10, 22)
"""Of the bundled drive, with something of a score between 0.5 and 0.8 before a surer car."""


def test_a_higher_score_leaves_boxes_out_and_moves_none() -> None:
    model = str(files("edge.zoo") / "compact-int8")
    with as_sequence(open_source(measuring_source())) as source, open_detector(model, threads=1) as detector:
        for index in FRAMES_WITH_HIDERS:
            most, _ = detector(source[index], score=0.5)
            few, _ = detector(source[index], score=0.8)
            kept = most.select(most.score > 0.8)
            assert 0 < len(kept) < len(most)
            np.testing.assert_array_equal(few.center_in_camera, kept.center_in_camera)


def test_scores_of_confidence_are_what_is_asked_for() -> None:
    model = str(files("edge.zoo") / "compact-int8")
    with as_sequence(open_source(measuring_source())) as source, open_detector(model, threads=1) as detector:
        frame = source[FRAMES_WITH_HIDERS[0]]
        weights = dict.fromkeys(FEATURES, 0.0) | {"logit": 1.0}
        manifest = replace(detector.manifest, confidence={"Car": (*weights.values(), -2.0)})
        told = Detector(replace(detector.directory, manifest=manifest), detector.session)
        raw, all_of_them = detector.look(frame).detections, told(frame, score=0.05)[0]
        shown = told(frame, score=0.5)[0]
    cars = raw.select(raw.class_id == raw.class_names.index("Car"))
    score = np.clip(cars.score, 1e-4, 1 - 1e-4)  # surer ones count as no surer
    expected = 1 / (1 + np.exp(2.0) * (1 - score) / score)
    found = all_of_them.select(all_of_them.class_id == raw.class_names.index("Car"))
    np.testing.assert_allclose(np.sort(found.score), np.sort(expected[expected > 0.05]), rtol=1e-6)
    assert 0 < len(shown) < np.count_nonzero(raw.score > 0.5)
    np.testing.assert_allclose(shown.score, all_of_them.score[all_of_them.score > 0.5])


def test_confidence_makes_nothing_sure_that_the_network_doubts() -> None:
    model = str(files("edge.zoo") / "compact-int8")
    with as_sequence(open_source(measuring_source())) as source, open_detector(model, threads=1) as detector:
        frame = source[FRAMES_WITH_HIDERS[0]]
        weights = dict.fromkeys(FEATURES, 0.0) | {"logit": 1.0}
        confidence = {name: (*weights.values(), 3.0) for name in detector.manifest.classes}
        manifest = replace(detector.manifest, confidence=confidence)
        told = Detector(replace(detector.directory, manifest=manifest), detector.session)
        all_of_them, shown = (told(frame, score=score)[0] for score in (0.05, 0.5))
    assert 0 < len(shown) < len(all_of_them)
    np.testing.assert_array_equal(shown.score, all_of_them.score[all_of_them.score > 0.5])


def test_without_refinement_boxes_stay_as_they_were_decoded() -> None:
    model = str(files("edge.zoo") / "compact-int8")
    with as_sequence(open_source(measuring_source())) as source, open_detector(model, threads=1) as detector:
        frame = source[FRAMES_WITH_HIDERS[0]]
        moved = detector.look(frame).detections
        manifest = replace(detector.manifest, depth_refinement=False)
        plain, _ = Detector(replace(detector.directory, manifest=manifest), detector.session)(frame)
    np.testing.assert_array_equal(plain.box_in_left_image, moved.box_in_left_image)
    assert np.abs(plain.center_in_camera[:, 2] - moved.center_in_camera[:, 2]).max() > 0.1
