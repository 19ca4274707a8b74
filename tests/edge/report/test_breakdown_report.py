"""Tables, record and pictures of what a model misses and invents."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from edge.evaluation.breakdown import break_down
from edge.evaluation.run import ModelRun
from edge.report.breakdown import breakdown_record, breakdown_tables
from edge.report.error_pictures import INVENTED, MISSED, VIEW_WH, case_of, cut_around, draw_case, write_error_pictures
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_labels
from runtime.contracts.objects import Detections3D

CLASSES = ("Car",)
SIZE_WH = (640, 200)
TRUTH = parse_labels("Car 0.10 1 0 100 60 200 140 1.5 1.6 3.9 -4 1.6 12 0\n")
FOUND = Detections3D(
    class_id=np.zeros(1, int),
    score=np.array([0.8]),
    box_in_left_image=np.array([[400.0, 80, 460, 120]]),
    center_in_camera=np.array([[4.0, 0.9, 20.0]]),
    size_hwl=np.array([[1.5, 1.6, 3.9]]),
    alpha_rad=np.zeros(1),
    yaw_rad=np.zeros(1),
    class_names=CLASSES,
)


class Frames:
    """Two frames, the first without labels."""

    uri = "toy:"

    def __getitem__(self, index: int) -> StereoFrame:
        P2 = np.array([[300.0, 0, 320, 0], [0, 300.0, 100, 0], [0, 0, 1, 0]])
        P3 = P2.copy()
        P3[0, 3] = -150.0
        image = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
        return StereoFrame(image, image, 0.0, index, f"0001/{index:06d}", StereoGeometry(P2, P3, SIZE_WH))


RUN = ModelRun("m/int8", CLASSES, 0.5, ("0001/000000", "0001/000001"), (None, TRUTH), (FOUND, FOUND), {})


def test_nothing_measured_gives_no_table() -> None:
    assert breakdown_tables(break_down([], [], score=0.5, classes=CLASSES), name="m") == []


def test_tables_and_record_say_the_same() -> None:
    found = break_down([TRUTH], [FOUND], score=0.5, classes=CLASSES)
    tables = {table.title: table for table in breakdown_tables(found, name="int8")}
    assert len(tables) == 4
    (row,) = tables["int8: objects found and missed by occlusion"].rows
    assert row[:4] == ("Car", "partly", "1", "0")
    inventions = [row[:5] for row in tables["int8: inventions by distance"].rows]
    assert inventions == [("Car", "0-15", "0", "0.00", "0"), ("Car", "15-30", "1", "1.00", "1")]
    record = json.loads(json.dumps(breakdown_record(found)))
    assert record["frames"] == 1
    missed = [row for row in record["rows"] if row["kind"] == "truncation"]
    assert [(row["band"], row["objects"], row["missed"]["unseen"]) for row in missed] == [("0-0.15", 1, 1)]


def test_pictures_show_each_case_and_are_listed(tmp_path: Path) -> None:
    found = break_down([TRUTH], [FOUND], score=0.5, classes=CLASSES)
    cases = write_error_pictures(tmp_path, Frames(), RUN, found.outcomes, [1], limit=5)
    assert [case["kind"] for case in cases] == ["missed", "invented"]
    assert {case["frame_id"] for case in cases} == {"0001/000001"}
    assert json.loads((tmp_path / "cases.json").read_text()) == cases
    assert sorted(path.name for path in tmp_path.glob("*.jpg")) == sorted(case["picture"] for case in cases)
    assert cv2.imread(str(tmp_path / cases[0]["picture"])).shape[1] > VIEW_WH[0]


def test_the_case_is_marked_in_its_colour() -> None:
    outcomes = break_down([TRUTH], [FOUND], score=0.5, classes=CLASSES).outcomes
    for item, colour in ((outcomes.missed[0], MISSED), (outcomes.inventions[0], INVENTED)):
        case = case_of(item, TRUTH, FOUND)
        picture = draw_case(Frames()[1], case, FOUND, TRUTH)
        assert (np.abs(picture.astype(int) - colour).sum(axis=-1) < 60).sum() > 200


def test_the_cut_of_a_square_image_has_the_shape_of_its_view() -> None:
    _, _, width, height = cut_around(np.array([100.0, 50.0, 400.0, 300.0]), (640, 480))
    assert width == 640 and height == round(640 * VIEW_WH[1] / VIEW_WH[0])


def test_the_cut_lies_in_the_image_and_holds_the_box() -> None:
    for box in ([0, 0, 30, 20], [600, 150, 640, 200], [10, 5, 630, 195], [300, 90, 310, 95]):
        left, top, width, height = cut_around(np.array(box, float), SIZE_WH)
        assert left >= 0 and top >= 0 and left + width <= SIZE_WH[0] and top + height <= SIZE_WH[1]
        if box[2] - box[0] < width:
            assert left <= box[0] and box[2] <= left + width
            assert top <= box[1] and box[3] <= top + height
