"""Objects found, missed and invented, one by one; recall and AP by distance, occlusion, truncation."""

from __future__ import annotations

import numpy as np
import pytest

from edge.evaluation.breakdown import BANDS, DISTANCE, OCCLUSION, TRUNCATION, break_down
from edge.evaluation.outcomes import (
    DOUBLE,
    FOUND,
    LOW_SCORE,
    MISPLACED,
    NOTHING_THERE,
    OTHER_CLASS,
    UNSEEN,
    judge,
)
from runtime.contracts.errors import FormatError
from runtime.contracts.kitti import parse_labels
from runtime.contracts.objects import Detections3D, Objects3D

NAMES = ("Car", "Pedestrian", "Cyclist")
DISPLAY = 0.5
FRAMES = 41  # fewer objects than recall points cannot reach 100 by the development kit


def label(x: float, z: float, *, name: str = "Car", occlusion: int = 0, truncation: float = 0.0) -> str:
    left, top, right, bottom = box_of(x, z)
    return (
        f"{name} {truncation:.2f} {occlusion} 0 {left:.2f} {top:.2f} {right:.2f} {bottom:.2f} "
        f"1.5 1.6 3.9 {x:.2f} 1.6 {z:.2f} 0"
    )


def box_of(x: float, z: float) -> tuple[float, float, float, float]:
    """Image box of a car-sized thing, 700 px of focal length."""
    return 600 + 700 * (x - 2) / z, 180 + 700 * 0.1 / z, 600 + 700 * (x + 2) / z, 180 + 700 * 1.6 / z


def labels(*lines: str) -> Objects3D:
    return parse_labels("\n".join(lines) + "\n" if lines else "")


def found(*rows: tuple[float, float, float, str]) -> Detections3D:
    """x, z, score, class; the image box follows from x and z."""
    count = len(rows)
    return Detections3D(
        class_id=np.array([NAMES.index(row[3]) for row in rows], int),
        score=np.array([row[2] for row in rows]),
        box_in_left_image=np.array([box_of(row[0], row[1]) for row in rows]).reshape(-1, 4),
        center_in_camera=np.array([[row[0], 1.6 - 0.75, row[1]] for row in rows]).reshape(-1, 3),
        size_hwl=np.tile([1.5, 1.6, 3.9], (count, 1)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=NAMES,
    )


def states(truth: Objects3D, boxes: Detections3D) -> tuple[list[str], list[str]]:
    outcomes = judge([truth], [boxes], score=DISPLAY, classes=NAMES)
    return [item.state for item in outcomes.targets], [item.state for item in outcomes.inventions]


def test_no_frames_and_empty_frames() -> None:
    assert judge([], [], score=DISPLAY).targets == ()
    assert break_down([], [], score=DISPLAY, classes=NAMES).rows == ()
    assert states(labels(), found()) == ([], [])
    assert states(labels(label(0, 10)), found()) == ([UNSEEN], [])
    assert states(labels(), found((0, 10, 0.9, "Car"))) == ([], [NOTHING_THERE])


@pytest.mark.parametrize(
    ("boxes", "target", "inventions"),
    [
        ([(0, 10, 0.9, "Car")], FOUND, []),
        ([(0, 10, 0.3, "Car")], LOW_SCORE, []),
        # 1.6 m wide, 3.9 m long across: 1.5 m further along z leaves no overlap in space but much in the image
        ([(0.0, 11.7, 0.9, "Car")], MISPLACED, [MISPLACED]),
        ([(0, 10, 0.9, "Pedestrian")], OTHER_CLASS, [OTHER_CLASS]),
        ([(0, 10, 0.9, "Car"), (0.4, 10.4, 0.8, "Car")], FOUND, [DOUBLE]),
        ([(0, 10, 0.9, "Car"), (9, 20, 0.8, "Car")], FOUND, [NOTHING_THERE]),
        ([(9, 20, 0.4, "Car")], UNSEEN, []),  # inventions below the display score are none
    ],
)
def test_each_state(boxes: list, target: str, inventions: list[str]) -> None:
    assert states(labels(label(0, 10)), found(*boxes)) == ([target], inventions)


def test_what_is_not_asked_for_is_neither_missed_nor_invented() -> None:
    unknown, small = label(0, 10, occlusion=3), label(0, 60)
    van, region = label(0, 10, name="Van"), "DontCare -1 -1 -10 400 100 800 320 -1 -1 -1 -1000 -1000 -1000 -10"
    for truth in (unknown, van, region):
        assert states(labels(truth), found((0, 10, 0.9, "Car"))) == ([], [])
    assert states(labels(small), found((0, 60, 0.9, "Car"))) == ([], [])


def test_the_surest_detection_takes_the_object() -> None:
    """Both overlap it in space; the second by more, but with less score."""
    outcomes = judge([labels(label(0, 10))], [found((0.3, 10.1, 0.9, "Car"), (0, 10, 0.7, "Car"))], score=DISPLAY)
    (target,) = outcomes.targets
    assert target.score == pytest.approx(0.9)
    assert [item.state for item in outcomes.inventions] == [DOUBLE]


def test_missed_ones_come_tallest_first_and_inventions_surest_first() -> None:
    truth = labels(label(0, 30), label(-5, 10), label(8, 20))
    outcomes = judge([truth], [found((3, 12, 0.6, "Car"), (-8, 40, 0.8, "Car"))], score=DISPLAY)
    heights = [item.height_px for item in outcomes.missed]
    assert heights == sorted(heights, reverse=True)
    assert [item.score for item in outcomes.inventions] == pytest.approx([0.8, 0.6])
    assert [item.row for item in outcomes.inventions] == [0, 1]


def test_lists_of_other_lengths_are_refused() -> None:
    with pytest.raises(FormatError, match="expected the same frames"):
        judge([labels()], [], score=DISPLAY)


def test_every_object_is_in_one_band_of_each_kind() -> None:
    random = np.random.default_rng(4)
    truth, boxes = [], []
    for _ in range(20):
        places = [(float(random.uniform(-3, 3)), z) for z in random.uniform(6, 38, 3)]
        kinds = [(int(random.integers(0, 3)), float(random.uniform(0, 0.9))) for _ in places]
        lines = [label(*place, occlusion=o, truncation=t) for place, (o, t) in zip(places, kinds, strict=True)]
        truth.append(labels(*lines))
        boxes.append(found(*[(x, z, float(random.uniform(0.1, 1)), "Car") for x, z in places if random.random() < 0.7]))
    result = break_down(truth, boxes, score=DISPLAY, classes=NAMES)
    total, hits = len(result.outcomes.targets), sum(item.state == FOUND for item in result.outcomes.targets)
    assert total > 40
    for kind in BANDS:
        rows = [row for row in result.rows if row.kind == kind]
        assert sum(row.objects for row in rows) == total
        assert sum(row.found for row in rows) == hits
        for row in rows:
            assert row.objects == row.found + sum(row.missed.values())
            low, high = row.recall_interval95
            assert 0 <= low <= high <= 1
            assert row.recall <= row.recall_any
    distance = [row for row in result.rows if row.kind == DISTANCE]
    assert sum(sum(row.invented.values()) for row in distance) == len(result.outcomes.inventions)


def test_ap_and_recall_of_a_band_are_its_own() -> None:
    """Near and hidden cars are found, the far visible one is not: each band says so, none blames another."""
    truth = [labels(label(-2, 10, occlusion=2), label(4, 35))] * FRAMES
    result = break_down(truth, [found((-2, 10, 0.9, "Car"))] * FRAMES, score=DISPLAY, classes=NAMES)
    rows = {(row.kind, row.band): row for row in result.rows}
    assert rows[DISTANCE, "0-15"].ap == pytest.approx(100.0)
    assert rows[DISTANCE, "30-45"].ap == 0.0
    assert rows[OCCLUSION, "largely"].ap == pytest.approx(100.0)
    assert rows[OCCLUSION, "visible"].recall == 0.0
    assert rows[OCCLUSION, "visible"].missed[UNSEEN] == FRAMES
    assert rows[TRUNCATION, "0-0.15"].recall == pytest.approx(0.5)
    assert rows[DISTANCE, "0-15"].recall_interval95 == (1.0, 1.0)


def test_an_unknown_kind_is_refused() -> None:
    with pytest.raises(FormatError, match="expected some of distance, occlusion, truncation"):
        break_down([], [], score=DISPLAY, classes=NAMES, kinds=("colour",))
