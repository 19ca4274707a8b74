"""The budget search, on a world where each layer in INT8 costs known points."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import ClassVar

import pytest

from quantize.budget import search_budget
from quantize.budget_kinds import KINDS, Budget, ap_drop_points, disagreement_points, shift_cm
from quantize.errors import QuantizeError
from runtime.contracts.measurement import NEAR_BAND, NEAR_M, Agreement, Measurement

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
            reference=REFERENCE,
            ranking=ranking or self.rank,
            budget=Budget("--max-drop", max_drop),
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
    assert result.best.lost <= max_drop
    assert len(world.built) == len(set(world.built)), "no model is tried twice"


@pytest.mark.parametrize("ranking", [[], ["d", "e"]])
def test_what_cannot_be_kept_is_said_and_the_best_is_named(ranking) -> None:
    result = World().search(1.0, ranking=lambda: ranking)
    assert not result.holds
    assert result.best.given_back == tuple(ranking)
    assert result.best.lost == min(step.lost for step in result.steps)


@pytest.mark.parametrize("limit", [-0.1, float("nan")])
@pytest.mark.parametrize("option", KINDS)
def test_a_wrong_budget_is_refused(option: str, limit: float) -> None:
    with pytest.raises(QuantizeError, match=f"{option}: .* 0 or more"):
        Budget(option, limit)


def test_drop_is_of_the_class_that_lost_most_at_its_loosest_overlap() -> None:
    before, after = record(80.0), record(78.5)
    assert ap_drop_points(before, after) == pytest.approx(1.5)
    assert ap_drop_points(after, before) == pytest.approx(-1.5)


@pytest.mark.parametrize("empty", [Measurement("m", {}, 3), record(80.0, objects=0)])
def test_frames_without_objects_cannot_hold_a_budget(empty) -> None:
    with pytest.raises(QuantizeError, match="no labelled objects"):
        ap_drop_points(empty, empty)


class Timed(World):
    """Layers in float take time; `b` was ranked high and hardly matters."""

    MS: ClassVar = {"a": 3.0, "b": 9.0, "c": 1.0, "d": 1.0, "e": 1.0}
    LOST: ClassVar = {"a": 4.0, "b": 0.1, "c": 2.0, "d": 0.2, "e": 0.1}

    def measure(self, path: Path) -> Measurement:
        floats = str(path).split(",")
        lost = sum(cost for name, cost in self.LOST.items() if name not in floats)
        ms = 10 + sum(cost for name, cost in self.MS.items() if name in floats)
        return dataclasses.replace(record(80.0 - lost), latency_ms={"inference": ms})


def timed_search(refinements: int, lines: list[str] | None = None):
    world = Timed()
    return search_budget(
        world.build,
        world.measure,
        reference=REFERENCE,
        ranking=lambda: ORDER,
        budget=Budget("--max-drop", 0.5),
        refinements=refinements,
        tell=(lines if lines is not None else []).append,
    )


def test_a_layer_that_the_metric_does_not_need_goes_back_to_int8() -> None:
    assert timed_search(0).best.given_back == ("a", "b", "c")
    best = timed_search(2).best
    assert best.given_back == ("a", "c")
    assert best.inference_ms == 14.0


def test_each_step_says_what_it_costs_in_time() -> None:
    lines: list[str] = []
    timed_search(0, lines)
    assert lines[0].endswith("10.0 ms")
    assert lines[1].endswith("13.0 ms (+3.0)")


@pytest.mark.parametrize(("share", "points"), [(1.0, 0.0), (0.97, 3.0), (0.0, 100.0)])
def test_disagreement_is_what_was_not_matched(share: float, points: float) -> None:
    compared = dataclasses.replace(record(1.0), agreement=Agreement(share, 10, 10, 0))
    assert disagreement_points(compared) == pytest.approx(points)


def test_disagreement_of_what_was_not_compared_is_refused() -> None:
    with pytest.raises(QuantizeError, match="no comparison"):
        disagreement_points(record(1.0))


def shifted(**mean_m: float) -> Measurement:
    """A measurement whose boxes of some distance bands moved so far; bands are named with _ for -."""
    bands = {name.removeprefix("m").replace("_", "-"): (0.0, value) for name, value in mean_m.items()}
    return dataclasses.replace(record(1.0), agreement=Agreement(1.0, 10, 10, 10, bands))


ITSELF = shifted(all=0.0, m0_30=0.0)


def test_shift_is_the_mean_of_the_near_band() -> None:
    after = shifted(all=0.5, m0_30=0.034, m15_30=0.9)
    assert after.agreement is not None and NEAR_BAND in after.agreement.centre_error_m
    assert shift_cm(ITSELF, after) == pytest.approx(3.4)
    assert Budget("--max-shift", 5.0).lost(ITSELF, after) == pytest.approx(3.4)
    assert not Budget("--max-shift", 5.0).labelled


def test_who_shows_no_near_box_is_off_by_all_of_it() -> None:
    assert shift_cm(ITSELF, shifted(all=0.5)) == pytest.approx(100 * NEAR_M)


@pytest.mark.parametrize(
    ("before", "said"), [(record(1.0), "no comparison"), (shifted(all=1.0), "no box .* within 30 m")]
)
def test_shift_of_what_is_not_there_is_refused(before: Measurement, said: str) -> None:
    with pytest.raises(QuantizeError, match=said):
        shift_cm(before, before)


def test_the_budgets_unit_is_said_at_each_step() -> None:
    lines: list[str] = []
    result = search_budget(
        lambda given_back: Path(",".join(given_back) or "none"),
        lambda place: shifted(m0_30=0.08 if place == Path("none") else 0.03),
        reference=ITSELF,
        ranking=lambda: ORDER,
        budget=Budget("--max-shift", 5.0),
        tell=lines.append,
    )
    assert result.best.given_back == ("a",)
    assert lines[0] == "0 layers in float: +8.00 cm of shift, budget 5 over"


def test_what_costs_nothing_is_tried_before_a_layer_is_given_back() -> None:
    """The second way loses half as much: it holds the budget with all layers in INT8."""
    world = World()
    built: list[tuple[str, tuple[str, ...]]] = []

    def way(name: str):
        def build(given_back) -> Path:
            built.append((name, tuple(given_back)))
            return Path(f"{name},{','.join(given_back)}")

        return build

    def measure(path: Path) -> Measurement:
        name, *floats = str(path).split(",")
        lost = sum(cost for layer, cost in COSTS.items() if layer not in floats)
        return record(80.0 - lost / {"plain": 1, "better": 2}[name])

    def search(max_drop: float):
        return search_budget(
            {"plain": way("plain"), "better": way("better")},
            measure,
            reference=REFERENCE,
            ranking=world.rank,
            budget=Budget("--max-drop", max_drop),
        )

    wide = search(8.0)
    assert wide.best.way == "plain"
    assert built == [("plain", ())]
    built.clear()
    middle = search(4.0)
    assert (middle.best.way, middle.best.given_back) == ("better", ())
    assert not world.asked_for_ranking
    built.clear()
    narrow = search(2.0)  # 7.75 / 2 is over, (7.75 - 4) / 2 is not
    assert (narrow.best.way, narrow.best.given_back) == ("better", ("a",))
    assert [name for name, given_back in built if given_back] == ["better"]
