"""calibration.json: write, read, what is missing, what is damaged."""

from __future__ import annotations

import json

import pytest

from calib.choice_record import choice_text, parse_choice, read_choice
from calib.coverage import Coverage
from calib.frames import CalibrationSet, ChosenFrame
from runtime.contracts.errors import FormatError
from runtime.model_folder import CALIBRATION_FILE

CHOSEN = CalibrationSet(
    source="kitti-object:object?split=train",
    frames=(ChosenFrame("000007", 7, "ab" * 8, "cd" * 8), ChosenFrame("000001", 1, "ef" * 8, "cd" * 8)),
    available=60,
    method="coverage",
    coverage=Coverage(0.75, 0.5, 1.25, 60, ("light", "classes (labels)")),
)


def test_what_is_written_is_read() -> None:
    assert parse_choice(choice_text(CHOSEN)) == CHOSEN
    assert parse_choice(choice_text(CHOSEN.first(1))) == CHOSEN.first(1)


def test_it_says_what_a_later_run_asks() -> None:
    content = json.loads(choice_text(CHOSEN))
    assert content["pixels_sha256"] == CHOSEN.digest
    assert content["geometry_sha256"] == CHOSEN.geometry_digest
    assert content["features"] == "scene-1"
    assert content["coverage"]["pool"] == 60


def test_a_newer_or_shorter_file_still_tells_its_frames() -> None:
    content = json.loads(choice_text(CHOSEN))
    newer = {**content, "schema": 9, "weather": "rain", "coverage": {"other": 1}}
    assert parse_choice(json.dumps(newer)).frames == CHOSEN.frames
    (frame,) = parse_choice('{"frames": [{"frame_id": "000001", "pixels": "ab"}]}').frames
    assert (frame.frame_id, frame.pixels, frame.index) == ("000001", "ab", -1)


HUGE = '{"frames": [{"frame_id": "a", "pixels": "ab", "index": 1e999}]}'


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", "null", '{"frames": 5}', '{"frames": [{"pixels": "ab"}]}', "\x00", HUGE]
)
def test_a_damaged_file_is_one_clear_error(text) -> None:
    with pytest.raises(FormatError, match=r"calibration\.json: found no record") as raised:
        parse_choice(text)
    assert "\n" not in str(raised.value)


def test_a_directory_may_have_none(tmp_path) -> None:
    assert read_choice(tmp_path) is None
    (tmp_path / CALIBRATION_FILE).write_text(choice_text(CHOSEN), encoding="utf-8")
    assert read_choice(tmp_path) == CHOSEN
