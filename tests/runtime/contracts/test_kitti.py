"""KITTI text: read, write, refuse, and the official result file to the last digit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge.detector.presets import preset
from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import (
    format_calib,
    format_detections,
    format_labels,
    parse_calib,
    parse_detections,
    parse_labels,
    parse_tracking_labels,
)
from runtime.decode import NetworkBoxes, to_detections
from runtime.preprocess import network_view

LINE = "Car 0.10 1 1.57 100.00 150.00 200.00 220.00 1.50 1.60 3.90 -2.00 1.70 20.00 1.47"
OFFICIAL_WRITER_MINIMUM = 0.4  # the official writer leaves lower scores out; ours leaves that to the caller


def test_empty_files() -> None:
    assert len(parse_labels("")) == 0
    assert len(parse_detections("\n")) == 0
    assert parse_tracking_labels("") == {}
    assert format_labels(parse_labels("")) == ""


def test_center_is_the_middle_of_the_box() -> None:
    objects = parse_labels(LINE)
    np.testing.assert_allclose(objects.center_in_camera, [[-2.0, 1.7 - 0.75, 20.0]])
    assert objects.class_names[objects.class_id[0]] == "Car"
    assert objects.occlusion[0] == 1 and objects.track_id[0] == -1


def test_labels_round_trip_with_dont_care() -> None:
    text = LINE + "\nDontCare -1 -1 -10 5 6 7 8 -1 -1 -1 -1000 -1000 -1000 -10\n"
    objects = parse_labels(text)
    again = parse_labels(format_labels(objects))
    for name in ("box_in_left_image", "center_in_camera", "size_hwl", "yaw_rad", "dont_care_boxes"):
        np.testing.assert_allclose(getattr(again, name), getattr(objects, name), atol=1e-4)
    assert len(again) == 1 and again.dont_care_boxes.shape == (1, 4)


def test_tracking_labels_round_trip() -> None:
    text = f"0 7 {LINE}\n2 9 {LINE}\n2 -1 DontCare -1 -1 -10 5 6 7 8 -1 -1 -1 -1000 -1000 -1000 -10\n"
    frames = parse_tracking_labels(text)
    assert set(frames) == {0, 2}
    assert frames[2].track_id[0] == 9 and len(frames[2].dont_care_boxes) == 1
    again = parse_tracking_labels(format_labels(frames[2], tracking_frame=2))
    assert again[2].track_id[0] == 9


@pytest.mark.parametrize(("word", "share"), [("0", 0.0), ("1", 0.3), ("2", 0.8), ("0.25", 0.25), ("1.00", 1.0)])
def test_tracking_labels_give_levels_of_truncation(word: str, share: float) -> None:
    kind, _, rest = LINE.split(" ", 2)
    frame = parse_tracking_labels(f"0 7 {kind} {word} {rest}\n")[0]
    assert frame.truncation.tolist() == [share]


def test_tracking_labels_call_a_sitting_person_person() -> None:
    frame = parse_tracking_labels(f"3 1 {LINE.replace('Car', 'Person')}\n")[3]
    assert frame.class_names[frame.class_id[0]] == "Person_sitting"
    with pytest.raises(FormatError, match="'Person'"):
        parse_labels(LINE.replace("Car", "Person"))


def test_detections_round_trip() -> None:
    found = parse_detections(LINE + " 0.75")
    again = parse_detections(format_detections(found))
    np.testing.assert_allclose(again.center_in_camera, found.center_in_camera, atol=1e-6)
    assert again.score[0] == 0.75


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Car 0.1", "fields"),
        (LINE.replace("20.00", "far"), "could not convert"),
        (LINE.replace("Car", "Spaceship"), "Spaceship"),
        (LINE + " 0.5 0.5", "fields"),
    ],
)
def test_malformed_labels(text: str, message: str) -> None:
    with pytest.raises(FormatError, match=message):
        parse_labels(text, where="000001.txt")


def test_detections_need_a_score() -> None:
    with pytest.raises(FormatError, match="15 fields, expected 16"):
        parse_detections(LINE)


def test_calibration_round_trip_and_refusals() -> None:
    P2 = np.array([[700.0, 0, 600, 40], [0, 700, 170, 0.2], [0, 0, 1, 0.003]])
    geometry = StereoGeometry(P2, P2 - np.array([[0, 0, 0, 380.0], [0] * 4, [0] * 4]), (1242, 375))
    again = parse_calib(format_calib(geometry), (1242, 375))
    np.testing.assert_allclose(again.P3, geometry.P3)
    row = " ".join(map(str, P2.ravel()))
    for text in (f"P2: {row}\nP3: {row}", f"P2 {row}\nP3 {row}", f"P_rect_02: {row}\nP_rect_03: {row}"):
        np.testing.assert_array_equal(parse_calib(text, (4, 4)).P2, P2)
    with pytest.raises(FormatError, match="no P2 and no P3"):
        parse_calib("P0: 1 2 3", (4, 4))
    with pytest.raises(FormatError, match="has 3 numbers"):
        parse_calib(f"P2: 1 2 3\nP3: {row}", (4, 4))


def test_official_result_file(golden_dir: Path) -> None:
    facts = json.loads((golden_dir / "data_pipeline.json").read_text())["result_writer"]
    boxes = np.array(facts["boxes"], np.float32)
    scores = np.array(facts["scores"])
    order = np.argsort(-scores)
    kept = order[scores[order] >= OFFICIAL_WRITER_MINIMUM]
    names = tuple(dict.fromkeys(facts["names"]))
    original = np.array(facts["P2_original"])
    view = network_view(StereoGeometry(original, original, (1242, 375)), preset("paper").manifest())
    np.testing.assert_allclose(view.geometry.P2, facts["P2_network"], atol=1e-9)
    found = NetworkBoxes(boxes[kept], scores[kept], np.array([names.index(facts["names"][row]) for row in kept]), kept)
    ours = format_detections(to_detections(found, view, names, official_angles=True))
    # ours are sorted by score, the recording is in the order given
    assert sorted(ours.splitlines()) == sorted(facts["file_text"].splitlines())
