"""Latency percentiles."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.latency import KEPT_SAMPLES, LatencyLog, summarize


def test_no_frame() -> None:
    assert LatencyLog().summary() == {}


def test_one_frame() -> None:
    figures = summarize([3.0])
    assert (figures.count, figures.p50, figures.p90, figures.p99, figures.largest) == (1, 3.0, 3.0, 3.0, 3.0)


def test_percentiles_interpolate() -> None:
    figures = summarize(list(np.arange(101.0)))
    assert (figures.p50, figures.p90, figures.p99, figures.largest) == pytest.approx((50.0, 90.0, 99.0, 100.0))


def test_stages_keep_their_order_and_their_own_count() -> None:
    log = LatencyLog()
    log.add({"read": 1.0, "total": 5.0})
    log.add({"read": 3.0, "total": 7.0, "late": 1.0})
    summary = log.summary()
    assert list(summary) == ["read", "total", "late"]
    assert (summary["read"].p50, summary["total"].largest, summary["late"].count) == (2.0, 7.0, 1)


def test_a_stream_without_end_keeps_the_latest_frames_alone() -> None:
    log, frames = LatencyLog(kept=10), 1_005
    for value in range(frames):
        log.add({"total": float(frames - value)})  # from 1005 down to 1
    figures = log.summary()["total"]
    assert (figures.count, figures.largest) == (frames, frames)  # of all
    assert figures.p50 == pytest.approx(5.5)  # of the ten latest, 10 to 1


def test_a_recording_shorter_than_what_is_kept_is_exact() -> None:
    values = np.random.default_rng(0).uniform(1, 50, 1_000)
    assert len(values) <= KEPT_SAMPLES
    log = LatencyLog()
    for value in values:
        log.add({"total": float(value)})
    assert log.summary()["total"] == summarize(list(values))
