"""Keeps an accuracy budget: gives the worst layers back to float until the drop is small enough.

What costs nothing at run time comes first: other ways to write the same placement (rounded weights, corrected biases)
are measured before any layer is given back, and the best of them is what the search goes on with.

The search knows nothing of accuracy. It is handed a function that builds a model with given layers in
float, one that measures a model, and a budget that tells what one lost against another. It doubles the
number of layers given back, worst first, until the budget holds, then halves the last step to find how few
are enough. Noise ranks layers, but the metric decides: of the layers that were given back, a few are tried in
INT8 again, and stay so where the budget holds without them. Of all models that hold it, the one with the
shortest measured inference wins.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from quantize.budget_kinds import Budget
from runtime.contracts.measurement import Measurement

Build = Callable[[Sequence[str]], Path]


@dataclass(frozen=True, slots=True)
class BudgetStep:
    """One model that was tried.

    Attributes:
        given_back: layers in float.
        way: how the rest was written, of the ways that cost nothing; empty where there was one alone.
        lost: against the float model, in the budget's unit.
        measurement: all that was measured.
        holds: whether the budget holds.
    """

    given_back: tuple[str, ...]
    lost: float
    measurement: Measurement
    holds: bool
    way: str = ""

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


def search_budget(
    build: Build | Mapping[str, Build],
    measure: Callable[[Path], Measurement],
    *,
    reference: Measurement,
    ranking: Callable[[], Sequence[str]],
    budget: Budget,
    refinements: int = 0,
    tell: Callable[[str], None] = lambda line: None,
) -> BudgetResult:
    """Finds how few layers must stay float.

    Args:
        build: Layers in float -> a model directory; or several such ways by name, the most promising first.
        measure: Model directory -> measurement.
        reference: Measurement of the float model.
        ranking: Gives layer names, worst first; asked only when INT8 throughout is over budget.
        budget: What may be lost.
        refinements: How many of the layers given back are tried in INT8 again, the least noisy first.
        tell: Told one line a step.

    Raises:
        QuantizeError: The frames have nothing to measure the budget on.
    """
    steps: list[BudgetStep] = []
    ways = build if isinstance(build, Mapping) else {"": build}
    way = next(iter(ways))

    def attempt(given_back: Sequence[str]) -> BudgetStep:
        measurement = measure(ways[way](given_back))
        found = budget.lost(reference, measurement)
        step = BudgetStep(tuple(given_back), found, measurement, found <= budget.limit, way)
        steps.append(step)
        verdict = "holds" if step.holds else "over"
        tell(
            f"{way and way + ', '}{len(given_back)} layers in float: {found:+.2f} {budget.unit}, "
            f"budget {budget.limit:g} {verdict}{_cost(step, steps[0])}"
        )
        return step

    for way in ways:  # noqa: B007 - `attempt` reads it
        if attempt(()).holds:
            return BudgetResult(tuple(steps), steps[-1])
    way = min(steps, key=lambda step: step.lost).way
    order = list(ranking())
    over, count = 0, 1
    while order:
        count = min(count, len(order))
        if attempt(order[:count]).holds:
            break
        over = count
        if count == len(order):
            return BudgetResult(tuple(steps), min(steps, key=lambda step: step.lost))
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
    return BudgetResult(
        tuple(steps),
        _fastest([step for step in steps if step.holds]) if order else min(steps, key=lambda step: step.lost),
    )


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
