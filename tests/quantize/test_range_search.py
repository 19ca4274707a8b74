"""Ranges by their effect on the outputs: the measure itself, no time, and a clipped tensor that is found."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from calib.methods import METHODS  # noqa: E402
from calib.ranges import observe  # noqa: E402
from quantize.output_error import OutputError  # noqa: E402
from quantize.prepare import Prepared, prepare_model  # noqa: E402
from quantize.range_search import RangeSearch, _packed, _unpacked, search_ranges, settled_ranges  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from quantize.static import build  # noqa: E402
from runtime.contracts.manifest import open_model_directory  # noqa: E402

FLOAT32_RANGE = 1e-6
"""Relative: ranges are kept as float32."""
SEARCHED = slice(0, 2)
HELD_OUT = slice(6, 8)


@pytest.fixture
def prepared(toy_directory) -> Prepared:
    return prepare_model(open_model_directory(toy_directory), recipe_for_target("x86-vnni"))


@pytest.fixture
def observation(prepared, toy_feeds):
    placement = prepared.placement
    return observe(
        prepared.model, lambda: toy_feeds[:6], tensors=placement.observed, channel_tensors=placement.observed_channels
    )


def test_a_model_is_no_distance_from_itself(prepared, toy_feeds) -> None:
    assert OutputError(prepared.model, toy_feeds[:1]).of(prepared.model) == 0.0


def shifted(model: onnx.ModelProto, column: int, by: float) -> onnx.ModelProto:
    """The model with one column of its boxes moved."""
    copy = onnx.ModelProto.FromString(model.SerializeToString())
    bias = next(tensor for tensor in copy.graph.initializer if tensor.name == "box_deltas.last.bias")
    values = onnx.numpy_helper.to_array(bias).copy()
    values[column::12] += by
    bias.CopyFrom(onnx.numpy_helper.from_array(values, bias.name))
    return copy


def test_depth_counts_more_than_width_and_twice_the_error_four_times(prepared, toy_feeds) -> None:
    distance = OutputError(prepared.model, toy_feeds[:2])
    variance = {column: distance._variances[1][column] for column in (6, 9)}
    by_column = {column: distance.of(shifted(prepared.model, column, 0.1)) for column in variance}
    twice = distance.of(shifted(prepared.model, 6, 0.2))
    assert twice / by_column[6] == pytest.approx(4, rel=1e-3)
    ratio = by_column[6] * variance[6] / (by_column[9] * variance[9])
    assert ratio == pytest.approx(4, rel=1e-3)


def test_a_graph_that_is_clearly_behind_is_run_on_half_of_the_frames(prepared, toy_feeds) -> None:
    distance = OutputError(prepared.model, toy_feeds[:4])
    near, far = shifted(prepared.model, 6, 0.1), shifted(prepared.model, 6, 0.2)
    rival = distance.by_frame(near)
    assert sum(rival) == distance.of(near)
    assert distance.by_frame(far, rival=rival) == distance.by_frame(far)[:2]
    assert distance.by_frame(near, rival=rival) == rival
    assert distance.by_frame(near, rival=distance.by_frame(far)) == rival


def test_background_does_not_count(prepared, toy_feeds) -> None:
    """An error where the float model sees nothing is weighed by its probability of an object."""
    distance = OutputError(prepared.model, toy_feeds[:1])
    weights = distance._weights[0]
    logits = distance._wanted[0][0][0, :, :-1]
    assert weights.shape == (logits.shape[0],)
    assert weights[logits.max(axis=1).argmax()] == weights.max()
    np.testing.assert_allclose(weights, 1 / (1 + np.exp(-logits.max(axis=1).astype(np.float64))))


def test_without_work_it_is_the_best_method(prepared, observation, toy_feeds) -> None:
    found = search_ranges(prepared, observation, toy_feeds[SEARCHED], most_multiply_adds=0)
    distance = OutputError(prepared.model, toy_feeds[SEARCHED])
    errors = {method: distance.of(build(prepared, observation, observation.ranges(method)).model) for method in METHODS}
    assert found.trials == len(METHODS)
    assert found.method == min(errors, key=lambda name: errors[name])
    assert found.ranges == observation.ranges(found.method)
    assert found.first_error == found.error == errors[found.method]


def test_ranges_that_are_too_wide_become_narrower(prepared, observation, toy_feeds) -> None:
    """Statistics that say half as much again as there is: every method's range wastes a third of its levels."""
    spoiled = {
        name: dataclasses.replace(
            item,
            minimum=item.minimum * 1.5,
            maximum=item.maximum * 1.5,
            first_edge=item.first_edge * 1.5,
            bin_width=item.bin_width * 1.5,
        )
        for name, item in observation.tensors.items()
    }
    worse = dataclasses.replace(observation, tensors=spoiled)
    steps: list[tuple[int, int]] = []
    found = search_ranges(
        prepared,
        worse,
        toy_feeds[SEARCHED],
        most_multiply_adds=work_of(prepared, trials=24, frames=len(toy_feeds[SEARCHED])),
        progress=lambda stage, done, total: steps.append((done, total)),
    )
    assert found.trials == 24
    start = worse.ranges(found.method)
    assert found.error < found.first_error
    assert sum(found.ranges[name][1] < start[name][1] for name in start) > sum(
        found.ranges[name][1] > start[name][1] for name in start
    )
    assert steps[-1][0] == steps[-1][1]
    held_out = OutputError(prepared.model, toy_feeds[HELD_OUT])
    before, after = (held_out.of(build(prepared, worse, ranges).model) for ranges in (start, found.ranges))
    assert after < before


def test_it_ends_with_its_work_and_is_the_same_again(prepared, observation, toy_feeds) -> None:
    most = work_of(prepared, trials=len(METHODS) + 5, frames=1)
    found, again = (search_ranges(prepared, observation, toy_feeds[:1], most_multiply_adds=most) for _ in range(2))
    assert found.trials == len(METHODS) + 5
    assert again == found


def work_of(prepared, *, trials: int, frames: int) -> float:
    return (trials + 0.5) * frames * sum(prepared.products.values())


def test_a_search_survives_the_cache() -> None:
    found = RangeSearch({"a": (-1.25, 3.1), "b": (0.0, 7.0)}, "entropy", 0.5, 0.25, 11)
    again = _unpacked(_packed(found))
    assert (again.method, again.first_error, again.error, again.trials) == ("entropy", 0.5, 0.25, 11)
    assert again.name == "search from entropy"
    for name, ends in found.ranges.items():
        assert again.ranges[name] == pytest.approx(ends, rel=FLOAT32_RANGE)


def test_a_named_method_is_not_searched(prepared, observation) -> None:
    settled = settled_ranges(prepared, _calibration(observation), None, "percentile")  # type: ignore[arg-type]
    assert settled.ranges == observation.ranges("percentile")
    assert settled.name == "percentile"
    assert settled.trials == 0


def _calibration(observation):
    from quantize.calibration import Calibration

    return Calibration(None, observation, from_cache=False)  # type: ignore[arg-type]
