"""The budget search, on a world where each layer in INT8 costs known points."""

from __future__ import annotations

from pathlib import Path

import pytest

from quantize.budget import ap_drop_points, search_budget
from quantize.errors import QuantizeError
from runtime.contracts.measurement import Measurement

COSTS = {"a": 4.0, "b": 2.0, "c": 1.0, "d": 0.5, "e": 0.25}
ORDER = list(COSTS)


def record(points: float, *, objects: int = 10, overlaps: tuple[str, ...] = ("0.7", "0.5")) -> Measurement:
    levels = {"R40": [0.0, points, 0.0], "R11": [0.0, 0.0, 0.0]}
    ap = {"Car": {"3d": {overlap: levels if overlap == "0.5" else {"R40": [0.0] * 3} for overlap in overlaps}}}
    return Measurement(path="model", ap=ap, frames=5, objects={"Car": [0, objects, 0]})


REFERENCE = record(80.0)


class World:
    """Builds and measures models, and counts how often."""

    def __init__(self) -> None:
        self.built: list[tuple[str, ...]] = []
        self.asked_for_ranking = False

    def build(self, given_back) -> Path:
        self.built.append(tuple(given_back))
        return Path(",".join(given_back) or "all-int8")

    def measure(self, path: Path) -> Measurement:
        floats = str(path).split(",")
        return record(80.0 - sum(cost for name, cost in COSTS.items() if name not in floats))

    def rank(self) -> list[str]:
        self.asked_for_ranking = True
        return ORDER

    def search(self, max_drop: float, ranking=None):
        return search_budget(
            self.build,
            self.measure,
            drop_points=lambda after: ap_drop_points(REFERENCE, after),
            ranking=ranking or self.rank,
            max_drop=max_drop,
        )


def test_a_wide_budget_needs_no_search() -> None:
    world = World()
    result = world.search(10.0)
    assert result.holds
    assert result.best.given_back == ()
    assert not world.asked_for_ranking
    assert world.built == [()]


@pytest.mark.parametrize(
    ("max_drop", "needed"), [(7.0, 1), (4.0, 1), (1.75, 2), (1.0, 3), (0.75, 3), (0.3, 4), (0.25, 4), (0.0, 5)]
)
def test_as_few_layers_as_needed_are_given_back_worst_first(max_drop, needed) -> None:
    world = World()
    result = world.search(max_drop)
    assert result.holds
    assert result.best.given_back == tuple(ORDER[:needed])
    assert result.best.drop_points <= max_drop
    assert len(world.built) == len(set(world.built)), "no model is tried twice"


@pytest.mark.parametrize("ranking", [[], ["d", "e"]])
def test_what_cannot_be_kept_is_said_and_the_best_is_named(ranking) -> None:
    result = World().search(1.0, ranking=lambda: ranking)
    assert not result.holds
    assert result.best.given_back == tuple(ranking)
    assert result.best.drop_points == min(step.drop_points for step in result.steps)


@pytest.mark.parametrize("max_drop", [-0.1, float("nan")])
def test_a_wrong_budget_is_refused(max_drop) -> None:
    with pytest.raises(QuantizeError, match="--max-drop"):
        World().search(max_drop)


def test_drop_is_of_the_class_that_lost_most_at_its_loosest_overlap() -> None:
    before, after = record(80.0), record(78.5)
    assert ap_drop_points(before, after) == pytest.approx(1.5)
    assert ap_drop_points(after, before) == pytest.approx(-1.5)


@pytest.mark.parametrize("empty", [Measurement("m", {}, 3), record(80.0, objects=0)])
def test_frames_without_objects_cannot_hold_a_budget(empty) -> None:
    with pytest.raises(QuantizeError, match="no labelled objects"):
        ap_drop_points(empty, empty)
