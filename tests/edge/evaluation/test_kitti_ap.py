"""AP against recorded numbers of the official code and of a published detector, and its plain properties."""

from __future__ import annotations

import json
import sys
import tarfile
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge.evaluation.kitti_ap import evaluate
from edge.evaluation.rules import EVALUATED_CLASSES
from edge.evaluation.text_folders import read_text_frames
from runtime.contracts.errors import FormatError
from runtime.contracts.kitti import KITTI_CLASSES, parse_detections, parse_labels
from runtime.contracts.objects import Detections3D, Objects3D

GOLDEN = Path(__file__).resolve().parents[2] / "golden" / "evaluation"
RECORDED_TOLERANCE = 1e-5  # per cent; the recordings have six decimals
PUBLISHED_TOLERANCE = 1e-3  # per cent; the published curves were rounded before their mean was taken
PUBLISHED_SECONDS = 60.0

LABEL = "Car 0.00 0 0.10 {left} 150.00 {right} 220.00 1.50 1.60 3.90 {x} 1.60 20.00 0.30"


def car(x: float, *, score: float | None = None) -> str:
    left = 600.0 + 36.0 * x
    line = LABEL.format(left=left, right=left + 120.0, x=x)
    return line if score is None else f"{line} {score}"


def frames_of(labels: list[str], detections: list[str]) -> tuple[list[Objects3D], list[Detections3D]]:
    return [parse_labels(text) for text in labels], [parse_detections(text) for text in detections]


def as_detections(labels: Objects3D, score: float) -> Detections3D:
    return Detections3D(
        class_id=labels.class_id,
        score=np.full(len(labels), score),
        box_in_left_image=labels.box_in_left_image,
        center_in_camera=labels.center_in_camera,
        size_hwl=labels.size_hwl,
        alpha_rad=labels.alpha_rad,
        yaw_rad=labels.yaw_rad,
        class_names=labels.class_names,
    )


def flat(tree: dict, path: tuple[str, ...] = ()) -> dict[tuple[str, ...], list[float]]:
    if isinstance(tree, list):
        return {path: tree}
    return {key: value for name, branch in tree.items() for key, value in flat(branch, (*path, name)).items()}


def test_no_frames_at_all():
    evaluation = evaluate([], [])
    assert evaluation.objects == {name: [0, 0, 0] for name in EVALUATED_CLASSES}
    assert all(value == [0.0, 0.0, 0.0] for value in flat(evaluation.ap()).values())


def test_nothing_labelled_and_nothing_found():
    evaluation = evaluate(*frames_of([""], [""]))
    assert all(value == [0.0, 0.0, 0.0] for value in flat(evaluation.ap()).values())


def test_labels_without_detections_score_zero():
    evaluation = evaluate(*frames_of([car(0.0)], [""]))
    assert evaluation.objects["Car"] == [1, 1, 1]
    assert evaluation.ap()["Car"]["3d"]["0.7"]["R40"] == [0.0, 0.0, 0.0]


def test_detections_without_labels_score_zero():
    assert evaluate(*frames_of([""], [car(0.0, score=0.9)])).ap()["Car"]["2d"]["0.7"]["R11"] == [0.0, 0.0, 0.0]


def test_lists_of_different_length_are_refused():
    with pytest.raises(FormatError, match="same frames"):
        evaluate([Objects3D.empty(KITTI_CLASSES)], [])


def test_schema_has_each_metric_at_its_overlaps():
    tree = evaluate(*frames_of([car(0.0)], [car(0.0, score=0.9)])).ap()
    assert {name: {metric: list(item) for metric, item in tree[name].items()} for name in tree} == {
        "Car": {"2d": ["0.7"], "aos": ["0.7"], "bev": ["0.7", "0.5"], "3d": ["0.7", "0.5"]},
        "Pedestrian": {"2d": ["0.5"], "aos": ["0.5"], "bev": ["0.5", "0.25"], "3d": ["0.5", "0.25"]},
        "Cyclist": {"2d": ["0.5"], "aos": ["0.5"], "bev": ["0.5", "0.25"], "3d": ["0.5", "0.25"]},
    }


def test_labels_against_themselves_are_perfect_where_recall_is_reached():
    # 60 objects: more than the 41 recall points, so that every point is reached
    labels = ["\n".join(car(x) for x in (-8.0, 0.0, 8.0)) for _ in range(20)]
    truth = [parse_labels(text) for text in labels]
    found = [as_detections(item, 0.1 + 0.04 * index) for index, item in enumerate(truth)]
    tree = evaluate(truth, found).ap()["Car"]
    for path, values in flat(tree).items():
        assert values == pytest.approx([100.0] * 3, abs=RECORDED_TOLERANCE), path


def test_aos_is_left_out_for_a_class_without_observation_angle():
    nameless = car(0.0, score=0.9).replace(" 0.10 ", " -10 ", 1)
    walker = "Pedestrian 0.00 0 0.10 300.00 150.00 330.00 220.00 1.70 0.60 0.80 -8.00 1.60 20.00 0.30 0.8"
    tree = evaluate(*frames_of([car(0.0)], [f"{nameless}\n{walker}"])).ap()
    assert "aos" not in tree["Car"]
    assert "aos" in tree["Pedestrian"]


@pytest.mark.parametrize(
    ("label", "expected_false"),
    [
        (car(0.0).replace("Car", "Van"), False),  # a neighbouring class is neither right nor wrong
        (car(0.0).replace("Car", "Truck"), True),  # any other class is wrong
        ("DontCare -1 -1 -10 590 140 730 230 -1 -1 -1 -1000 -1000 -1000 -10", False),  # on the image: excused
    ],
)
def test_what_excuses_a_detection_in_2d(label: str, expected_false: bool):
    # the excused (or wrong) detection outranks a right one, so that precision tells
    labels, found = frames_of([f"{label}\n{car(8.0)}"], [f"{car(0.0, score=0.9)}\n{car(8.0, score=0.5)}"])
    r11 = evaluate(labels, found).ap()["Car"]["2d"]["0.7"]["R11"][1]
    assert r11 == pytest.approx((50.0 if expected_false else 100.0) / 11, abs=RECORDED_TOLERANCE)


def test_dont_care_excuses_nothing_on_the_ground_plane():
    region = "DontCare -1 -1 -10 590 140 730 230 -1 -1 -1 -1000 -1000 -1000 -10"
    labels, found = frames_of([f"{region}\n{car(8.0)}"], [f"{car(0.0, score=0.9)}\n{car(8.0, score=0.5)}"])
    assert evaluate(labels, found).ap()["Car"]["bev"]["0.7"]["R11"][1] == pytest.approx(50.0 / 11)


@pytest.mark.parametrize("case", ["empty_detections", "handmade", "noise_small"])
def test_golden_cases(case: str):
    golden = json.loads((GOLDEN / f"{case}.json").read_text(encoding="utf-8"))
    got = flat(evaluate(*frames_of(golden["labels"], golden["detections"])).ap())
    for path, values in flat(golden["expected"]).items():
        assert got[path] == pytest.approx(values, abs=RECORDED_TOLERANCE), path


@pytest.mark.parametrize("case", ["empty_detections", "handmade", "noise_small", "noise_medium", "noise_large"])
def test_reference_cases(reference_dir: Path, case: str):
    sys.path.insert(0, str(GOLDEN))
    try:
        from make_cases import pack
    finally:
        sys.path.remove(str(GOLDEN))
    recorded = pack(reference_dir / "eval" / case)
    got = flat(evaluate(*frames_of(recorded["labels"], recorded["detections"])).ap())
    assert recorded["expected"]
    for path, values in flat(recorded["expected"]).items():
        assert got[path] == pytest.approx(values, abs=RECORDED_TOLERANCE), path


@pytest.mark.slow
def test_published_detector(kitti_dir: Path, tmp_path: Path):
    for name in ("labels_and_splits", "published_detections"):
        with tarfile.open(kitti_dir / f"{name}.tar.xz") as archive:
            archive.extractall(tmp_path, filter="data")
    found = next(tmp_path.glob("fpointnet*/data"))
    begin = time.perf_counter()
    frames = read_text_frames(tmp_path / "label_2", found, tmp_path / "ImageSets" / "val.txt")
    got = flat(evaluate(frames.labels, frames.detections).ap())
    assert time.perf_counter() - begin < PUBLISHED_SECONDS
    assert len(frames.frame_ids) == 3769
    expected = json.loads((kitti_dir / "published_detections_expected.json").read_text(encoding="utf-8"))
    for path, values in flat(expected).items():
        assert got[path] == pytest.approx(values, abs=PUBLISHED_TOLERANCE), path


@settings(max_examples=30, deadline=None)
@given(scores=st.permutations([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]), seed=st.integers(0, 1000))
def test_ap_depends_on_the_order_of_scores_only(scores: list[float], seed: int):
    generator = np.random.default_rng(seed)
    places = [-8.0, -4.0, 0.0, 4.0, 8.0, 12.0]
    labels = ["\n".join(car(x) for x in places[:4])]
    shifts = generator.uniform(-0.6, 0.6, size=len(places))

    def score(monotone) -> dict[tuple[str, ...], list[float]]:
        rows = zip(places, shifts, scores, strict=True)
        lines = [car(x + shift, score=monotone(value)) for x, shift, value in rows]
        return flat(evaluate(*frames_of(labels, ["\n".join(lines)])).ap())

    assert score(lambda value: value) == score(lambda value: value**3)
