"""The parity report: passes on equal networks, fails on unequal ones, and never on nothing."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.native.library import library_path

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")
from export.errors import ExportError  # noqa: E402
from export.parity import GOAL, OutputParity, ParityReport, measure_parity  # noqa: E402

pytestmark = pytest.mark.torch

OUTPUTS = ("cls_logits", "box_deltas")


def frames(count: int) -> list[dict[str, np.ndarray]]:
    rng = np.random.default_rng(5)
    return [
        {name: rng.standard_normal((1, 3, 32, 96)).astype(np.float32) for name in ("left", "right")}
        for _ in range(count)
    ]


def test_no_frame_is_an_error(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ExportError, match="found no frame"):
        measure_parity(two_view_network, exported, [])


def test_equal_networks_pass(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    report = measure_parity(two_view_network, exported, frames(3))
    assert report.passed and report.frames == 3 and report.goal == GOAL == 1e-4
    assert [output.name for output in report.outputs] == list(OUTPUTS)
    for output in report.outputs:
        assert 0 < output.worst < GOAL
        assert (output.native is not None) == (library_path() is not None)
    assert all(name in line for name, line in zip(OUTPUTS, report.lines(), strict=True))


def test_one_changed_weight_fails_the_output_that_it_reaches(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    with torch.no_grad():
        two_view_network.boxes.weight[0, 0] += 0.01
    report = measure_parity(two_view_network, exported, frames(1))
    assert [output.worst > GOAL for output in report.outputs] == [False, True]
    assert not report.passed


def test_the_worst_frame_counts(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    with torch.no_grad():
        two_view_network.boxes.bias[0] += 0.01
    dark = {name: np.zeros((1, 3, 32, 96), np.float32) for name in ("left", "right")}
    alone = measure_parity(two_view_network, exported, [dark]).outputs[1].worst
    both = measure_parity(two_view_network, exported, [dark, *frames(1)]).outputs[1].worst
    assert both >= alone > GOAL


def test_values_that_are_not_finite_fail(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    frame = frames(1)[0]
    frame["left"][0, 0, 0, 0] = np.nan
    assert not measure_parity(two_view_network, exported, [frame]).passed


def test_leaves_the_mode_of_the_module(two_view_network, exported: bytes) -> None:  # type: ignore[no-untyped-def]
    two_view_network.train()
    assert measure_parity(two_view_network, exported, frames(1)).passed
    assert two_view_network.training


@pytest.mark.parametrize(("body", "native", "passed"), [(1e-5, None, True), (1e-5, 2e-4, False), (2e-4, 1e-5, False)])
def test_either_way_of_computing_can_fail(body: float, native: float | None, passed: bool) -> None:
    report = ParityReport((OutputParity("out", body, native),), frames=1, goal=GOAL)
    assert report.passed is passed
