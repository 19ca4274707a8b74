"""curve.json and curve.png."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edge.report.curve import CurvePoint, write_curve
from runtime.model_folder import CURVE_PLOT, CURVE_RECORD

POINTS = [
    CurvePoint("coverage", 4, 0.5, 0.97, 0.05, 1.0),
    CurvePoint("coverage", 1, 0.0, 0.90, None, 2.0),
    CurvePoint("spread", 1, 0.0, 0.91, 0.06, None),
]


@pytest.mark.parametrize("points", [[], POINTS, POINTS[2:]])
def test_record_and_picture_are_written(tmp_path: Path, points) -> None:
    pytest.importorskip("matplotlib")
    assert write_curve(tmp_path, points, calibration="a", range_method="mse", measured_on="b", measured_frames=7)
    record = json.loads((tmp_path / CURVE_RECORD).read_text(encoding="utf-8"))
    assert [(item["choice"], item["frames"]) for item in record["points"]] == [(p.choice, p.frames) for p in points]
    assert record["measured_frames"] == 7
    assert (tmp_path / CURVE_PLOT).read_bytes().startswith(b"\x89PNG")


def test_without_matplotlib_the_record_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*arguments: object) -> None:
        raise ImportError

    monkeypatch.setattr("edge.report.curve._draw", missing)
    assert not write_curve(tmp_path, POINTS, calibration="a", range_method="mse", measured_on="b", measured_frames=7)
    assert [path.name for path in tmp_path.iterdir()] == [CURVE_RECORD]
