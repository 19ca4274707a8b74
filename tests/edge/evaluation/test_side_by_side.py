"""Models that take turns find what each finds alone, and every frame is read once."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edge.evaluation.run import run_model
from edge.evaluation.side_by_side import run_side_by_side
from runtime.contracts.errors import SourceError
from runtime.sources.factory import open_source
from tests.edge.evaluation.test_measure import LiveSource


def silent(line: str) -> None:
    raise AssertionError(line)


def test_turns_find_what_each_model_finds_alone(toy_model: Callable[..., Path], toy_recording: Path):
    paths = [toy_model("fp32"), toy_model("worse", scores=(0.9, 0.0, 0.4))]
    steps: list[None] = []
    with open_source(f"kitti-object:{toy_recording}?split=val") as source:
        alone = [run_model(path, source) for path in paths]
        turns, benches = run_side_by_side(paths, source, on_frame=lambda: steps.append(None), warn=silent)
    assert len(steps) == 6
    for one, turn, bench, path in zip(alone, turns, benches, paths, strict=True):
        assert (turn.path, turn.classes, turn.score_display) == (one.path, one.classes, one.score_display)
        assert turn.frame_ids == one.frame_ids
        assert set(turn.latency_ms) == set(one.latency_ms)
        assert turn.latency_ms["total"] > turn.latency_ms["inference"]
        assert bench.path == str(path)
        assert bench.runs == 6
        for found, expected in zip(turn.detections, one.detections, strict=True):
            np.testing.assert_array_equal(found.score, expected.score)
            np.testing.assert_array_equal(found.box_in_left_image, expected.box_in_left_image)
    assert min(turns[1].detections[0].score) < turns[1].score_display  # AP needs what a stream does not show
    assert turns[0].labels[0] is not None


def test_a_source_without_recorded_frames_is_refused(toy_model: Callable[..., Path]):
    with pytest.raises(SourceError, match="live"):
        run_side_by_side([toy_model("fp32")], LiveSource(), warn=silent)
