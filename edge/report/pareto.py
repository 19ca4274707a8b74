"""The path of a budget search as a plot: points lost over milliseconds, one mark a model that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge.report.quantisation import BudgetRow

_SIZE_INCHES, _DOTS_PER_INCH = (6.0, 4.0), 110


def pareto_front(rows: Sequence[BudgetRow]) -> list[BudgetRow]:
    """The timed models that no other beats in both time and points, fastest first."""
    front: list[BudgetRow] = []
    timed = [(row.inference_ms, row.drop_points, row) for row in rows if row.inference_ms is not None]
    for _, points, row in sorted(timed, key=lambda item: item[:2]):
        if not front or points < front[-1].drop_points:
            front.append(row)
    return front


def write_budget_plot(path: Path, rows: Sequence[BudgetRow], *, max_drop: float) -> None:
    """Draw all models that were tried, their front and the budget.

    Args:
        path: PNG file to write.
        rows: of the search; those without a time are left out.
        max_drop: points that may be lost.

    Raises:
        ImportError: matplotlib is missing.
    """
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    front = pareto_front(rows)
    figure = Figure(figsize=_SIZE_INCHES, layout="constrained")
    axes = figure.add_subplot()
    for row in rows:
        if row.inference_ms is not None:
            axes.plot(row.inference_ms, row.drop_points, "o" if row.holds else "x", color="C0" if row.holds else "C3")
            axes.annotate(
                f"{len(row.given_back)} in float",
                (row.inference_ms, row.drop_points),
                textcoords="offset points",
                xytext=(5, 4),
                fontsize=8,
            )
    axes.step([row.inference_ms for row in front], [row.drop_points for row in front], where="post", lw=1)
    axes.axhline(max_drop, linestyle="--", color="0.4", lw=1)
    axes.set_xlabel("inference on this machine, ms a frame")
    axes.set_ylabel("points lost against float32")
    axes.set_title("Models tried; circles hold the budget (dashed)")
    figure.savefig(path, dpi=_DOTS_PER_INCH, metadata={"Software": None})
