"""The path of a budget search as a plot: what was lost over milliseconds, one mark a model that was tried."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge.report.quantisation import BudgetRow

_SIZE_INCHES, _DOTS_PER_INCH = (6.0, 4.0), 110


def pareto_front(rows: Sequence[BudgetRow]) -> list[BudgetRow]:
    """The timed models that no other beats in both time and what was lost, fastest first."""
    front: list[BudgetRow] = []
    timed = [(row.inference_ms, row.lost, row) for row in rows if row.inference_ms is not None]
    for _, lost, row in sorted(timed, key=lambda item: item[:2]):
        if not front or lost < front[-1].lost:
            front.append(row)
    return front


def write_budget_plot(path: Path, rows: Sequence[BudgetRow], *, limit: float, unit: str) -> None:
    """Draw all models that were tried, their front and the budget.

    Args:
        path: PNG file to write.
        rows: of the search; those without a time are left out.
        limit: what may be lost, in the unit.

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
            axes.plot(row.inference_ms, row.lost, "o" if row.holds else "x", color="C0" if row.holds else "C3")
            axes.annotate(
                f"{len(row.given_back)} in float",
                (row.inference_ms, row.lost),
                textcoords="offset points",
                xytext=(5, 4),
                fontsize=8,
            )
    axes.step([row.inference_ms for row in front], [row.lost for row in front], where="post", lw=1)
    axes.axhline(limit, linestyle="--", color="0.4", lw=1)
    axes.set_xlabel("inference on this machine, ms a frame")
    axes.set_ylabel(f"{unit}, against float32")
    axes.set_title("Models tried; circles hold the budget (dashed)")
    figure.savefig(path, dpi=_DOTS_PER_INCH, metadata={"Software": None})
