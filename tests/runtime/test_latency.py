"""Latency percentiles."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.latency import LatencyLog, summarize


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
