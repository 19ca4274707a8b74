"""Reports: tables from records, the two files, pictures of differences."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edge.evaluation.depth_error import DepthError
from edge.report.differences import AGREED, LOST, MOVED, NEW, compare_frame, draw_differences, most_different
from edge.report.document import NO_LABELS, NOT_MEASURED, model_names, report_tables, report_text
from edge.report.files import write_json
from edge.report.markdown import markdown_table
from edge.report.model_report import write_model_report
from edge.report.rows import Table
from runtime.contracts.errors import OutputError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.measurement import Agreement, Measurement
from runtime.contracts.objects import Detections3D

POINTS = {"R40": [50.0, 40.0, 30.0], "R11": [51.0, 41.0, 31.0]}
INTERVALS = {"R40": [[45.0, 55.0], [35.0, 45.0], [25.0, 35.0]], "R11": [[0.0, 1.0]] * 3}
DROPS = {"R40": [1.0, -2.0, 0.5], "R11": [0.0, 0.0, 0.0]}


def tree(leaf: dict) -> dict:
    return {"Car": {"3d": {"0.7": leaf}}}


def labelled() -> list[Measurement]:
    objects = {"Car": [10, 20, 0]}
    reference = Measurement("models/fp32", tree(POINTS), 5, objects, {"inference": 10.0}, None, tree(INTERVALS))
    agreed = Agreement(0.9, 10, 10, 9, {"all": (0.1, 0.2)})
    other = Measurement(
        "models/int8",
        tree(POINTS),
        5,
        objects,
        {"inference": 4.0},
        agreed,
        tree(INTERVALS),
        tree(DROPS),
        tree(INTERVALS),
    )
    return [reference, other]


def boxes(*lefts: float, depth: float = 20.0) -> Detections3D:
    count = len(lefts)
    left = np.array(lefts)
    x = (left + 25.0 - 128.0) * depth / 200.0
    return Detections3D(
        class_id=np.zeros(count),
        score=np.full(count, 0.9),
        box_in_left_image=np.column_stack([left, np.full(count, 40.0), left + 50.0, np.full(count, 80.0)]),
        center_in_camera=np.column_stack([x, np.ones(count), np.full(count, depth)]),
        size_hwl=np.tile([1.5, 1.6, 3.9], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=("Car",),
    )


def frame() -> StereoFrame:
    P2 = np.array([[200.0, 0, 128, 0], [0, 200.0, 64, 0], [0, 0, 1, 0]])
    P3 = P2.copy()
    P3[0, 3] = -108.0
    image = np.full((128, 256, 3), 90, np.uint8)
    return StereoFrame(image, image, 0.0, 0, "0001/000002", StereoGeometry(P2, P3, (256, 128)))


def test_nothing_measured_gives_no_table():
    assert report_tables([]) == []
    assert markdown_table(Table("empty", ("a",), ())) == ""
    text = report_text([], title="t", source="images:a,b")
    assert NOT_MEASURED in text and NO_LABELS not in text


def test_every_ap_stands_with_its_interval_and_number_of_objects():
    text = report_text(labelled(), title="t", source="kitti-object:x")
    assert "50.00 [45.0, 55.0]" in text
    assert "Labelled objects (easy / moderate / hard): Car 10 / 20 / 0" in text
    assert "-2.00 [+35.0, +45.0]" in text
    assert "30.00 [25.0" not in text  # no object is hard: no figure


def test_without_labels_only_agreement():
    reference = Measurement("a/fp32", {}, 5)
    other = Measurement("a/int8", {}, 5, agreement=Agreement(1.0, 0, 0, 0))
    tables = report_tables([reference, other])
    assert [table.title for table in tables] == ["Agreement with fp32"]


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/fp32", "a/int8"], ["fp32", "int8"]),
        (["/a/model", "/b/model"], ["a/model", "b/model"]),
        (["a/m", "a/m"], ["m (1)", "m (2)"]),
    ],
)
def test_names_are_as_short_as_they_can_be(paths: list[str], names: list[str]):
    assert model_names([Measurement(path, {}, 1) for path in paths]) == names


def test_files_hold_the_same_figures(tmp_path: Path):
    error = {"Car": {"all": DepthError(3, 0.5, -0.1, 0.02, 0.6, 0.7)}}
    write_model_report(
        tmp_path, labelled(), title="int8", source="kitti-object:x", facts={"recipe": "w8a8"}, depth_errors=[error]
    )
    text = (tmp_path / "report.md").read_text()
    record = json.loads((tmp_path / "report.json").read_text())
    assert "- recipe: w8a8" in text
    assert "| Car | all | 3 | 0.50 | 2.0 % | -0.10 | 0.60 | 0.70 |" in text
    assert record["models"][0]["depth_error"]["Car"]["all"]["found"] == 3
    assert record["against_first"][0]["detections"] == {"reference": 10, "other": 10, "matched": 9}
    assert record["facts"] == {"recipe": "w8a8"}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "report.md"]


def test_place_that_cannot_be_written(tmp_path: Path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        write_json(tmp_path / "taken" / "report.json", {})


def test_state_of_each_box():
    found = compare_frame(boxes(0.0, 100.0), boxes(2.0, 180.0))
    assert (found.lost, found.new, found.moved, found.count) == (1, 1, 0, 2)
    assert sorted(found.reference_colours) == sorted((AGREED, LOST))
    assert NEW in found.other_colours
    moved = compare_frame(boxes(0.0), boxes(0.0, depth=21.0))
    assert (moved.moved, moved.reference_colours, moved.other_colours) == (1, (MOVED,), (MOVED,))


def test_most_different_first_then_fuller():
    frames = [compare_frame(boxes(0.0), boxes(0.0)), compare_frame(boxes(0.0, 100.0), boxes(0.0, 100.0))]
    frames.append(compare_frame(boxes(0.0), boxes()))
    assert most_different(frames, 2) == [2, 1]
    assert most_different([], 3) == []


def test_picture_shows_each_state_in_its_colour():
    picture = draw_differences(frame(), compare_frame(boxes(0.0, 100.0), boxes(0.0, 180.0)), ("fp32", "int8"))
    assert picture.dtype == np.uint8
    half = picture.shape[0] // 2
    for colour, rows in ((LOST, slice(40, half - 40)), (NEW, slice(half + 40, -40))):
        near = np.abs(picture[rows, :1100].astype(int) - colour).sum(axis=-1) < 30
        assert near.sum() > 50


def test_picture_of_a_box_that_reaches_behind_the_camera():
    near = boxes(0.0, depth=0.5)
    assert draw_differences(frame(), compare_frame(near, near), ("a", "b")).shape[2] == 3
