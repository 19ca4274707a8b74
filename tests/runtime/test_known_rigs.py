"""Rigs with a known offset of the right image."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_calib
from runtime.known_rigs import KNOWN_RIGS, with_known_offset

GREY_LEFT = "721.5377 0 609.5593 0 0 721.5377 172.854 0 0 0 1 0"
GREY_RIGHT = "721.5377 0 609.5593 -387.5744 0 721.5377 172.854 0 0 0 1 0"
LEFT = "721.5377 0 609.5593 44.85728 0 721.5377 172.854 0.2163791 0 0 1 0.002745884"
RIGHT = "721.5377 0 609.5593 -339.5242 0 721.5377 172.854 2.199936 0 0 1 0.002729905"
SIZE_WH = (1242, 375)


def text(*, grey: str = GREY_RIGHT, right: str = RIGHT, raw: bool = False) -> str:
    names = [f"P_rect_0{index}" if raw else f"P{index}" for index in range(4)]
    return "".join(f"{name}: {row}\n" for name, row in zip(names, (GREY_LEFT, grey, LEFT, right), strict=True))


def corrected(calibration: str) -> tuple[StereoGeometry, StereoGeometry]:
    plain = parse_calib(calibration, SIZE_WH)
    return plain, with_known_offset(plain, calibration)


@pytest.mark.parametrize("raw", [False, True])
def test_the_rig_of_that_date_has_its_offset(raw: bool) -> None:
    plain, found = corrected(text(raw=raw))
    moved = found.P3 - plain.P3
    assert moved[0, 2] == pytest.approx(KNOWN_RIGS[0].right_offset_px)
    assert np.count_nonzero(moved) == 1
    np.testing.assert_array_equal(found.P2, plain.P2)


@pytest.mark.parametrize(
    "calibration",
    [
        text(grey=RIGHT),  # simulated: the grey cameras are copies of the coloured ones
        text(grey="1 2 3"),
        text(right=RIGHT.replace("-339.5242", "-334.1081")),  # another date
        f"P2: {LEFT}\nP3: {RIGHT}\n",
    ],
)
def test_any_other_rig_is_left_alone(calibration: str) -> None:
    plain, found = corrected(calibration)
    assert found is plain
