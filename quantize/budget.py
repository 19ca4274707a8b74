"""Keeps an accuracy budget: gives the worst layers back to float until the drop is small enough.

The search knows nothing of accuracy. It is handed a function that builds a model with given layers in
float, one that measures a model, and one that turns two measurements into points lost. It doubles the
number of layers given back, worst first, until the budget holds, then halves the last step to find how few
are enough.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from quantize.errors import QuantizeError
from runtime.contracts.measurement import Measurement

LEVEL_MODERATE = 1


@dataclass(frozen=True, slots=True)
class BudgetStep:
    """One model that was tried.

    Attributes:
        given_back: layers in float.
        drop_points: what it lost against the float model.
        measurement: all that was measured.
        holds: whether the budget holds.
    """

    given_back: tuple[str, ...]
    drop_points: float
    measurement: Measurement
    holds: bool


@dataclass(frozen=True, slots=True)
class BudgetResult:
    """The path of the search.

    Attributes:
        steps: all that was tried, in order.
        best: the step with the fewest layers in float that holds the budget; where none does, the one that
        lost least.
    """

    steps: tuple[BudgetStep, ...]
    best: BudgetStep

    @property
    def holds(self) -> bool:
        """Whether the budget holds."""
        return self.best.holds


def search_budget(
    build: Callable[[Sequence[str]], Path],
    measure: Callable[[Path], Measurement],
    *,
    drop_points: Callable[[Measurement], float],
    ranking: Callable[[], Sequence[str]],
    max_drop: float,
    tell: Callable[[str], None] = lambda line: None,
) -> BudgetResult:
    """Finds how few layers must stay float.

    Args:
        build: Layers in float -> a model directory.
        measure: Model directory -> measurement.
        drop_points: Measurement -> points lost against the float model; below zero where it won.
        ranking: Gives layer names, worst first; asked only when INT8 throughout is over budget.
        max_drop: Points that may be lost.
        tell: Told one line a step.

    Raises:
        QuantizeError: ``max_drop`` is negative or not a number.
    """
    if not max_drop >= 0:
        raise QuantizeError(f"--max-drop: found {max_drop}; expected points of 0 or more; 0.5 is strict, 2 is loose")
    steps: list[BudgetStep] = []

    def attempt(given_back: Sequence[str]) -> BudgetStep:
        measurement = measure(build(given_back))
        lost = drop_points(measurement)
        step = BudgetStep(tuple(given_back), lost, measurement, lost <= max_drop)
        steps.append(step)
        verdict = "holds" if step.holds else "over"
        tell(f"{len(given_back)} layers in float: {lost:+.2f} points lost, budget {max_drop:g} {verdict}")
        return step

    if attempt(()).holds:
        return BudgetResult(tuple(steps), steps[0])
    order = list(ranking())
    over, count = 0, 1
    while order:
        count = min(count, len(order))
        if attempt(order[:count]).holds:
            break
        over = count
        if count == len(order):
            return BudgetResult(tuple(steps), min(steps, key=lambda step: step.drop_points))
        count *= 2
    enough = count
    while enough - over > 1:
        middle = (over + enough) // 2
        if attempt(order[:middle]).holds:
            enough = middle
        else:
            over = middle
    holding = [step for step in steps if step.holds]
    if not holding:
        return BudgetResult(tuple(steps), min(steps, key=lambda step: step.drop_points))
    return BudgetResult(tuple(steps), min(holding, key=lambda step: len(step.given_back)))


def ap_drop_points(reference: Measurement, other: Measurement) -> float:
    """Points of 3D AP (R40, moderate) lost by the class that lost most.

    Each class counts at its loosest 3D overlap, where few objects say most; classes without moderate
    objects are left out.

    Raises:
        QuantizeError: No class has labelled objects to measure on.
    """
    lost = []
    for name, metrics in reference.ap.items():
        if reference.objects.get(name, [0, 0, 0])[LEVEL_MODERATE] == 0 or "3d" not in metrics:
            continue
        overlap = min(metrics["3d"], key=float)
        before = metrics["3d"][overlap]["R40"][LEVEL_MODERATE]
        lost.append(before - other.ap[name]["3d"][overlap]["R40"][LEVEL_MODERATE])
    if not lost:
        raise QuantizeError(
            "--validation: found no labelled objects of the model's classes; expected some for a budget in AP points; "
            "give a labelled source"
        )
    return max(lost)
