"""One run for a whole curve, and nothing that grows with the number of frames."""

from __future__ import annotations

import tracemalloc
import weakref
from contextlib import contextmanager

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402

import calib.ranges as ranges_module  # noqa: E402
from calib.pool import look_at  # noqa: E402
from calib.ranges import observe, observe_prefixes  # noqa: E402
from runtime.contracts.frame import StereoFrame  # noqa: E402
from runtime.contracts.geometry import StereoGeometry  # noqa: E402

SIDE = 256
ARRAY_BYTES = 4 * SIDE * SIDE
ALIVE = 4
"""Arrays of a kind that may be alive at once: this frame's and the one before, each with its view."""
GROWTH_BYTES = ARRAY_BYTES // 2
"""Far less than one array: between the peaks of a few frames and of many there is room for lists of numbers alone."""


@pytest.fixture
def model() -> onnx.ModelProto:
    """y = relu(x) + x."""
    nodes = [helper.make_node("Relu", ["x"], ["positive"]), helper.make_node("Add", ["positive", "x"], ["y"])]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, 2, 3]) for name in ("x", "y")]
    graph = helper.make_graph(nodes, "sum", ends[:1], ends[1:])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


@pytest.mark.parametrize("group_bytes", [1 << 30, 24])
def test_first_parts_are_seen_as_if_run_alone(model, group_bytes, monkeypatch) -> None:
    random = np.random.default_rng(0)
    feeds = [{"x": random.normal(0, 1 + i, (1, 2, 3)).astype(np.float32)} for i in range(6)]
    split = ranges_module.split_groups
    monkeypatch.setattr(ranges_module, "split_groups", lambda names, sizes: split(names, sizes, group_bytes))
    wanted = {"tensors": ["positive", "y"], "channel_tensors": ["y"], "bytes_of": {"positive": 24, "y": 24}}
    seen = observe_prefixes(model, lambda: feeds, counts=(1, 4, 99), **wanted)
    assert sorted(seen) == [1, 4, 6]
    for count, found in seen.items():
        alone = observe(model, lambda kept=count: feeds[:kept], **wanted)
        assert found.frames == count
        for name, statistics in alone.tensors.items():
            np.testing.assert_array_equal(found.tensors[name].counts, statistics.counts)
            assert (found.tensors[name].minimum, found.tensors[name].maximum) == (
                statistics.minimum,
                statistics.maximum,
            )
        np.testing.assert_array_equal(found.channels["y"], alone.channels["y"])


class Watched:
    """Makes arrays and knows how many of them were ever alive at once."""

    def __init__(self) -> None:
        self.alive, self.most = 0, 0

    def array(self, values: np.ndarray) -> np.ndarray:
        self.alive += 1
        self.most = max(self.most, self.alive)
        weakref.finalize(values, self._gone)
        return values

    def _gone(self) -> None:
        self.alive -= 1


def observed_peak_bytes(model, monkeypatch, frames: int) -> tuple[int, Watched]:
    """Peak of Python's and NumPy's memory while ``frames`` frames are observed by a session that makes new arrays."""
    watched = Watched()

    class Session:
        def run(self, feed, outputs):
            return [watched.array(feed["x"] + place) for place, _ in enumerate(outputs)]

    @contextmanager
    def open_fake(model_bytes, *, name):
        yield Session()

    monkeypatch.setattr(ranges_module, "open_session", open_fake)

    def feeds():
        for number in range(frames):
            yield {"x": watched.array(np.full((1, 1, SIDE, SIDE), number, np.float32))}

    tracemalloc.start()
    observe(model, feeds, tensors=["positive", "y"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak, watched


def test_memory_does_not_grow_with_the_frames(model, monkeypatch) -> None:
    few, _ = observed_peak_bytes(model, monkeypatch, 5)
    many, watched = observed_peak_bytes(model, monkeypatch, 100)
    assert many < few + GROWTH_BYTES
    assert watched.most <= 2 * 3  # a feed and two outputs, of this frame and of the one before
    assert watched.alive == 0


def test_a_pool_holds_one_frame_at_a_time() -> None:
    watched = Watched()

    class Drive:
        def __len__(self) -> int:
            return 300

        def __getitem__(self, index: int) -> StereoFrame:
            left, right = (watched.array(np.full((32, 64, 3), index % 250, np.uint8)) for _ in range(2))
            geometry = StereoGeometry(np.eye(3, 4), np.eye(3, 4), (64, 32))
            return StereoFrame(left, right, 0.0, index, f"{index:06d}", geometry)

    pool = look_at(Drive(), 100, use_cache=False)
    assert len(pool.frames) == 300
    assert watched.most <= ALIVE
    assert watched.alive == 0
