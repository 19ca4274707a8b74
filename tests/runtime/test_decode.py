"""Decoding: box code both ways, recorded detections, labels that belong to their boxes, the camera frame."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.detector.presets import preset
from runtime.boxcode import ALPHA, X1, Y2, Z, decode_boxes, encode_boxes
from runtime.contracts.geometry import StereoGeometry, project_to_image
from runtime.contracts.manifest import AnchorLayout, AnchorPriors, Manifest, read_priors
from runtime.decode import Decoder, NetworkBoxes, to_detections
from runtime.preprocess import NetworkView

BOX_TOLERANCE_PX = 1e-4  # float32 exponentials of another NumPy
METRIC_TOLERANCE = 1e-5
P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])


def paper_manifest(size_hw: tuple[int, int]) -> Manifest:
    return replace(preset("paper").manifest(input_type="float32"), input_size_hw=size_hw)


def plain_priors(layout: AnchorLayout, classes: int = 2) -> AnchorPriors:
    shape = (classes, layout.scale_count, len(layout.ratios), 6)
    mean = np.broadcast_to(np.array([20, 0.1, 0.9, 1.6, 1.5, 3.9], np.float32), shape).copy()
    return AnchorPriors(mean, np.full(shape, 0.5, np.float32))


def test_nothing_passes_gives_no_detection() -> None:
    manifest = paper_manifest((32, 64))
    decoder = Decoder(manifest, plain_priors(manifest.anchors))
    count = 2 * 4 * 48
    found = decoder.decode_in_network(
        np.full((1, count, 3), -20, np.float32), np.zeros((1, count, 12), np.float32), P2=P2, score=0.5
    )
    assert len(found.score) == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**31 - 1))
def test_encoding_inverts_decoding(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count = 7
    anchors = {
        "anchor_center_xy": rng.uniform(0, 600, (count, 2)).astype(np.float32),
        "anchor_size_wh": rng.uniform(10, 200, (count, 2)).astype(np.float32),
        "prior_mean": np.tile(np.array([20, 0, 0, 1.6, 1.5, 3.9], np.float32), (count, 1)),
        "prior_std": np.tile(np.array([4, 0.7, 0.7, 0.1, 0.1, 0.4], np.float32), (count, 1)),
    }
    angle = rng.uniform(-np.pi / 2 + 0.01, np.pi / 2 - 0.01, count)
    deltas = rng.normal(0, 1, (count, 12)).astype(np.float32)
    deltas[:, 7] = np.sin(2 * angle) / 0.7
    deltas[:, 8] = np.cos(2 * angle) / 0.7
    boxes = decode_boxes(deltas, facing_away=np.zeros(count, bool), **anchors)
    np.testing.assert_allclose(boxes[:, ALPHA], angle, atol=1e-5)
    np.testing.assert_allclose(encode_boxes(boxes, **anchors), deltas, atol=2e-3)

    plain = decode_boxes(deltas, facing_away=np.zeros(count, bool), depth_by_prior=False, **anchors)
    probability = 1 / (1 + np.exp(-deltas[:, 6].astype(np.float64)))
    np.testing.assert_allclose(plain[:, Z], 1 / probability - 1, rtol=1e-5)  # the paper's form
    np.testing.assert_array_equal(np.delete(plain, Z, axis=1), np.delete(boxes, Z, axis=1))
    np.testing.assert_allclose(encode_boxes(plain, depth_by_prior=False, **anchors), deltas, atol=2e-3)


def test_absurd_regressions_stay_finite() -> None:
    anchors = {
        "anchor_center_xy": np.full((1, 2), 50, np.float32),
        "anchor_size_wh": np.full((1, 2), 20, np.float32),
        "prior_mean": np.ones((1, 6), np.float32),
        "prior_std": np.ones((1, 6), np.float32),
    }
    boxes = decode_boxes(np.full((1, 12), 1e4, np.float32), facing_away=np.zeros(1, bool), **anchors)
    assert np.isfinite(boxes).all()


def test_recorded_detections(golden_dir: Path, golden_module: Callable[[str], ModuleType]) -> None:
    recorded = np.load(golden_dir / "decode_nms.npz")
    manifest = paper_manifest((96, 320))
    decoder = Decoder(manifest, read_priors(golden_dir / "priors.npz", manifest.classes, manifest.anchors))
    outputs = golden_module("official/recorded_inputs.py").head_outputs(
        11, (1, 5760, 2), logits=(-3.6, 2.2), facing_shift=5, box_deviation=0.7
    )
    valid = recorded["prior_valid"]

    candidates = decoder.candidates(*outputs, P2=recorded["P2"], score=0.75)
    np.testing.assert_array_equal(candidates.anchor_index, recorded["candidate_anchor_index"][valid])
    np.testing.assert_array_equal(candidates.class_id, recorded["candidate_label"][valid])
    np.testing.assert_allclose(
        candidates.boxes[:, Y2 + 1 :], recorded["decoded_before_clip"][valid][:, Y2 + 1 :], atol=METRIC_TOLERANCE
    )

    found = decoder.decode_in_network(*outputs, P2=recorded["P2"], score=0.75)
    np.testing.assert_array_equal(found.class_id, recorded["label_aligned"])
    assert np.any(recorded["label_official"] != recorded["label_aligned"])  # the flaw that is not kept
    np.testing.assert_allclose(found.score, recorded["scores"], atol=1e-6)
    np.testing.assert_allclose(found.boxes[:, X1 : Y2 + 1], recorded["boxes"][:, X1 : Y2 + 1], atol=BOX_TOLERANCE_PX)
    np.testing.assert_allclose(found.boxes[:, Y2 + 1 :], recorded["boxes"][:, Y2 + 1 :], atol=METRIC_TOLERANCE)


def test_boxes_without_prior_are_dropped() -> None:
    manifest = paper_manifest((32, 64))
    priors = plain_priors(manifest.anchors)
    priors.mean[1, ..., 0] = -100.0
    decoder = Decoder(manifest, priors)
    count = 2 * 4 * 48
    logits = np.full((1, count, 3), -20, np.float32)
    centred = np.array([[700.0, 0, 32, 0], [0, 700, 16, 0], [0, 0, 1, 0]])
    usable = np.flatnonzero(decoder.usable(centred))
    logits[0, usable[:2]] = [[-20, 5, 1], [5, -20, 1]]
    found = decoder.candidates(logits, np.zeros((1, count, 12), np.float32), P2=centred, score=0.5)
    assert list(found.class_id) == [0] and list(found.anchor_index) == [usable[1]]


def test_boxes_off_the_ground_of_their_class_are_dropped_only_by_option() -> None:
    layout = AnchorLayout(filter_by_class=True)
    manifest = replace(paper_manifest((32, 64)), anchors=layout)
    priors = plain_priors(layout)
    priors.mean[0, ..., 0] = 200.0  # 8 rows off the horizon are 2.3 m there, 0.23 m for the second class
    logits = np.full((1, 2 * 4 * 48, 3), -20, np.float32)
    logits[0, :2] = [[5, -20, 1], [-20, 5, 1]]
    deltas = np.zeros((1, 2 * 4 * 48, 12), np.float32)
    centred = np.array([[700.0, 0, 32, 0], [0, 700, 16, 0], [0, 0, 1, 0]])
    found = Decoder(manifest, priors).candidates(logits, deltas, P2=centred, score=0.5)
    assert list(found.class_id) == [1] and list(found.anchor_index) == [1]
    any_class = replace(manifest, anchors=replace(layout, filter_by_class=False))
    found = Decoder(any_class, priors).candidates(logits, deltas, P2=centred, score=0.5)
    assert list(found.class_id) == [0, 1]


def test_camera_frame_round_trip() -> None:
    geometry = StereoGeometry(P2, P3, (1242, 375))
    view = NetworkView(
        100,
        1.25,
        (288, 1280),
        geometry,
        geometry.crop(left=0, top=100, size_wh=(1242, 275)).scale((1.25, 1.25), (1280, 288)),
    )
    center = np.array([[-4.0, 0.9, 17.5]])
    pixel, _ = project_to_image(view.geometry.P2, center)
    row = np.array([[300, 50, 400, 120, *pixel[0], 17.5, 1.6, 1.5, 3.9, 2.0]], np.float32)
    found = NetworkBoxes(row, np.array([0.9], np.float32), np.array([0]), np.array([3]))
    detections = to_detections(found, view, ("Car",))
    np.testing.assert_allclose(detections.center_in_camera, center, atol=5e-3)  # t_z, 2.7 mm, is left out
    np.testing.assert_allclose(detections.box_in_left_image, [[240, 140, 320, 196]], atol=1e-4)
    np.testing.assert_allclose(detections.size_hwl, [[1.5, 1.6, 3.9]], atol=1e-6)
    assert -np.pi <= detections.yaw_rad[0] < np.pi


def test_boxes_behind_the_camera_are_dropped() -> None:
    geometry = StereoGeometry(P2, P3, (1242, 375))
    view = NetworkView(0, 1.0, (375, 1242), geometry, geometry)
    rows = np.zeros((2, 11), np.float32)
    rows[:, :4] = [10, 10, 20, 20]
    rows[:, 6] = [-1.0, 10.0]
    rows[:, 7:10] = 1.0
    found = NetworkBoxes(rows, np.array([0.9, 0.8], np.float32), np.array([0, 0]), np.array([0, 1]))
    assert len(to_detections(found, view, ("Car",))) == 1
