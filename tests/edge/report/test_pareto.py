"""The plot of a budget search: nothing timed, one model, and a front."""

from __future__ import annotations

from pathlib import Path

import pytest

from edge.report.pareto import pareto_front, write_budget_plot
from edge.report.quantisation import BudgetRow


def row(layers: int, points: float, ms: float | None) -> BudgetRow:
    return BudgetRow(tuple("abcdef"[:layers]), points, ms, points <= 1.0)


def test_of_nothing_the_front_is_empty() -> None:
    assert pareto_front([]) == []
    assert pareto_front([row(0, 1.0, None)]) == []


def test_slower_and_worse_is_not_on_the_front() -> None:
    fast, good, slow, equal = row(0, 4.0, 10.0), row(2, 0.5, 12.0), row(1, 4.5, 11.0), row(3, 0.5, 13.0)
    assert pareto_front([slow, equal, good, fast]) == [fast, good]


@pytest.mark.parametrize("rows", [[row(0, 0.0, 5.0)], [row(0, 4.0, 10.0), row(2, 0.5, 12.0), row(3, 0.4, None)]])
def test_a_picture_is_written_and_the_same_again(rows, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    pytest.importorskip("matplotlib")
    for name in ("one.png", "two.png"):
        write_budget_plot(tmp_path / name, rows, limit=1.0, unit="points lost")
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()
    picture = cv2.imread(str(tmp_path / "one.png"))
    assert picture.shape == (440, 660, 3)
    assert (picture != 255).any()
