"""Which way candidates are thinned, and that a library of another build is not believed."""

from __future__ import annotations

import numpy as np
import pytest

from runtime.candidates import Thinning, thinning
from runtime.nms import non_maximum_suppression
from runtime.voting import voted_boxes


def test_the_library_is_left_out_where_it_is_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert thinning(use_native=False) == Thinning()
    monkeypatch.setenv("EDGE_NATIVE", "0")
    assert thinning() == Thinning(non_maximum_suppression, voted_boxes)


def test_a_library_of_another_build_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("runtime.candidates.record_call", lambda symbol: lambda *records: False)
    found = thinning()
    assert found != Thinning()
    rng = np.random.default_rng(1)
    boxes = rng.uniform(0, 20, (40, 11)).astype(np.float32)
    boxes[:, 2:4] += 20
    score = rng.uniform(0.1, 1, 40).astype(np.float32)
    ids = rng.integers(0, 2, 40)
    keep = found.suppress(boxes[:, :4], score, 0.6)
    np.testing.assert_array_equal(keep, non_maximum_suppression(boxes[:, :4], score, 0.6))
    np.testing.assert_array_equal(
        found.vote(boxes, score, ids, keep, iou=0.3), voted_boxes(boxes, score, ids, keep, iou=0.3)
    )
