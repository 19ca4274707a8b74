"""Keeps an accuracy budget: gives the worst layers back to float until the drop is small enough.

The search knows nothing of accuracy. It is handed a function that builds a model with given layers in
float, one that measures a model, and one that turns two measurements into points lost. It doubles the
number of layers given back, worst first, until the budget holds, then halves the last step to find how few
are enough. Noise ranks layers, but the metric decides: of the layers that were given back, a few are tried in
INT8 again, and stay so where the budget holds without them. Of all models that hold it, the one with the
shortest measured inference wins.
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

    @property
    def inference_ms(self) -> float | None:
        """Median milliseconds of one inference, None where it was not measured."""
        return self.measurement.latency_ms.get("inference")


@dataclass(frozen=True, slots=True)
class BudgetResult:
    """The path of the search.

    Attributes:
        steps: all that was tried, in order.
        best: the fastest step that holds the budget, of equal ones that with the fewest layers in float; where
        none does, the one that lost least.
    """

    steps: tuple[BudgetStep, ...]
    best: BudgetStep

    @property
    def holds(self) -> bool:
        """Whether the budget holds."""
        return self.best.holds

    @property
    def front(self) -> tuple[BudgetStep, ...]:
        """The steps that no other beats in both time and points, fastest first; empty where time is unknown."""
        front: list[BudgetStep] = []
        timed = [step for step in self.steps if step.inference_ms is not None]
        for step in sorted(timed, key=lambda item: (item.inference_ms, item.drop_points)):
            if not front or step.drop_points < front[-1].drop_points:
                front.append(step)
        return tuple(front)


def search_budget(
    build: Callable[[Sequence[str]], Path],
    measure: Callable[[Path], Measurement],
    *,
    drop_points: Callable[[Measurement], float],
    ranking: Callable[[], Sequence[str]],
    max_drop: float,
    refinements: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> BudgetResult:
    """Finds how few layers must stay float.

    Args:
        build: Layers in float -> a model directory.
        measure: Model directory -> measurement.
        drop_points: Measurement -> points lost against the float model; below zero where it won.
        ranking: Gives layer names, worst first; asked only when INT8 throughout is over budget.
        max_drop: Points that may be lost.
        refinements: How many of the layers given back are tried in INT8 again, the least noisy first.
        tell: Told one line a step.

    Raises:
        QuantizeError: ``max_drop`` is negative or not a number.
    """
    if not max_drop >= 0:
        raise QuantizeError(
            f"--max-drop or --max-disagreement: found {max_drop}; expected points of 0 or more; 0.5 is strict"
        )
    steps: list[BudgetStep] = []

    def attempt(given_back: Sequence[str]) -> BudgetStep:
        measurement = measure(build(given_back))
        lost = drop_points(measurement)
        step = BudgetStep(tuple(given_back), lost, measurement, lost <= max_drop)
        steps.append(step)
        verdict = "holds" if step.holds else "over"
        tell(
            f"{len(given_back)} layers in float: {lost:+.2f} points lost, budget {max_drop:g} {verdict}"
            f"{_cost(step, steps[0])}"
        )
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
    kept = list(order[:enough])
    # The last one is known to be needed: without it the budget did not hold.
    for layer in kept[-2::-1][:refinements]:
        fewer = [item for item in kept if item != layer]
        if attempt(fewer).holds:
            kept = fewer
    return BudgetResult(tuple(steps), _fastest([step for step in steps if step.holds]) if order else steps[0])


def _fastest(steps: Sequence[BudgetStep]) -> BudgetStep:
    """By measured time where all have one, then by layers in float."""
    timed = all(step.inference_ms is not None for step in steps)
    return min(steps, key=lambda step: ((step.inference_ms or 0.0) if timed else 0.0, len(step.given_back)))


def _cost(step: BudgetStep, first: BudgetStep) -> str:
    """What a model costs in time, and how much more than with all layers in INT8."""
    if step.inference_ms is None or first.inference_ms is None:
        return ""
    if step is first:
        return f", {step.inference_ms:.1f} ms"
    return f", {step.inference_ms:.1f} ms ({step.inference_ms - first.inference_ms:+.1f})"


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


def disagreement_points(other: Measurement) -> float:
    """Share of detections without a partner in the float model's, in points of 100; needs no labels.

    Raises:
        QuantizeError: The measurement was not compared with the float model.
    """
    if other.agreement is None:
        raise QuantizeError("--max-disagreement: found no comparison; expected one with the float model; measure both")
    return 100.0 * (1.0 - other.agreement.matched_share)
