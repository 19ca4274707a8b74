"""What a budget search calls: a model and a source in, a measurement out."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from edge.evaluation.measure import assess, measure, measurement
from edge.evaluation.run import run_model
from runtime.contracts.errors import FormatError, SourceError
from runtime.sources.factory import open_source


class LiveSource:
    """A camera that never gets to send anything."""

    uri = "oak:"
    is_live = True


@pytest.fixture
def uri(toy_recording: Path) -> str:
    return f"kitti-object:{toy_recording}?split=val"


def test_a_source_that_is_live_is_refused(toy_model: Callable[..., Path]):
    with pytest.raises(SourceError, match="live"):
        run_model(toy_model("fp32"), LiveSource())


def test_reference_alone(toy_model: Callable[..., Path], uri: str):
    model = toy_model("fp32")
    record = measure(model, uri)
    assert (record.path, record.frames, record.agreement, record.drop) == (str(model), 6, None, {})
    assert record.objects == {"Car": [15, 15, 15], "Pedestrian": [0, 0, 0]}
    assert record.ap["Car"]["2d"]["0.7"]["R40"][1] > 0
    low, high = record.ap_interval95["Car"]["2d"]["0.7"]["R40"][1]
    assert low <= high
    assert set(record.latency_ms) == {"read", "preprocess", "inference", "decode", "refine", "total"}


def test_against_a_reference_on_one_open_source(toy_model: Callable[..., Path], uri: str):
    with open_source(uri) as source:
        reference = assess(run_model(toy_model("fp32"), source))
        same = measure(toy_model("same"), source, reference)
        worse = measure(toy_model("worse", scores=(0.9, 0.0, 0.7)), source, reference)
    assert same.agreement is not None
    assert same.agreement.matched_share == 1.0
    assert same.drop["Car"]["3d"]["0.7"]["R40"] == [0.0] * 3
    assert worse.drop["Car"]["3d"]["0.7"]["R40"][1] > 0
    assert worse.agreement is not None
    assert worse.agreement.reference_count - worse.agreement.other_count == 6


def test_display_threshold_decides_agreement_but_not_ap(toy_model: Callable[..., Path], uri: str):
    with open_source(uri) as source:
        reference = assess(run_model(toy_model("fp32"), source))
        # order of scores kept, one below the display threshold of 0.5
        faint = measure(toy_model("faint", scores=(0.9, 0.8, 0.3)), source, reference)
    assert faint.drop["Car"]["3d"]["0.7"]["R40"] == [0.0] * 3
    assert faint.agreement is not None
    assert faint.agreement.matched_count == 12


def test_other_frames_are_refused(toy_model: Callable[..., Path], uri: str):
    model = toy_model("fp32")
    with open_source(f"{uri}&limit=2") as source:
        reference = assess(run_model(model, source))
    with pytest.raises(FormatError, match="same frames"):
        measure(model, uri, reference)


def test_progress_is_told_once_a_frame(toy_model: Callable[..., Path], uri: str):
    calls: list[None] = []
    with open_source(uri) as source:
        run = run_model(toy_model("fp32"), source, on_frame=lambda: calls.append(None))
    assert len(calls) == len(run.frame_ids) == 6
    assert measurement(assess(run)).frames == 6
