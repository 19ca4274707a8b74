"""Histograms with the range of 8 bits."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.report.histograms import RangePlot, write_range_plots


def plot(counts: list[int]) -> RangePlot:
    return RangePlot("layer", np.array(counts), -2.0, 1.0, low=-1.0, high=1.0, minimum=-2.0, maximum=2.0)


@pytest.mark.parametrize(("counts", "share"), [([0, 0, 0, 0], 0.0), ([0, 4, 4, 0], 0.0), ([1, 5, 1, 1], 0.25)])
def test_share_of_values_outside(counts: list[int], share: float) -> None:
    assert plot(counts).share_outside == share


def test_one_picture_of_all(tmp_path: Path) -> None:
    write_range_plots(tmp_path / "ranges.png", [plot([1, 5, 1, 1]), plot([0, 0, 0, 0]), plot([0, 9, 2, 0])])
    assert cv2.imread(str(tmp_path / "ranges.png")) is not None
