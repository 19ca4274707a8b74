"""Observation of a running model, in groups of bounded size, and its cache."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper  # noqa: E402

from calib.cache import cache_folder, cache_key, load, store  # noqa: E402
from calib.ranges import Observation, observe, split_groups  # noqa: E402
from runtime.contracts.errors import FormatError  # noqa: E402


@pytest.fixture
def model() -> onnx.ModelProto:
    """y = relu(x) + x, [1, 2, 3]."""
    nodes = [helper.make_node("Relu", ["x"], ["positive"]), helper.make_node("Add", ["positive", "x"], ["y"])]
    shape = [1, 2, 3]
    ends = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name in ("x", "y")]
    graph = helper.make_graph(nodes, "sum", ends[:1], ends[1:])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


@pytest.fixture
def feeds() -> list[dict[str, np.ndarray]]:
    random = np.random.default_rng(0)
    return [{"x": random.normal(0, 1, (1, 2, 3)).astype(np.float32)} for _ in range(4)]


def test_inner_tensors_and_channels_are_seen(model, feeds) -> None:
    told: list[tuple[str, int, int]] = []
    seen = observe(
        model,
        lambda: feeds,
        tensors=["positive", "y"],
        channel_tensors=["y"],
        frame_count=4,
        progress=lambda *step: told.append(step),
    )
    x = np.concatenate([feed["x"] for feed in feeds])
    assert seen.frames == 4
    assert seen.ranges("minmax")["positive"] == (max(x.min(), 0), x.max())
    y = np.maximum(x, 0) + x
    np.testing.assert_array_equal(seen.channels["y"][1], y.max(axis=(0, 2)))
    assert told[-1] == ("calibrating", 4, 4)


def test_groups_give_the_same_and_run_the_frames_once_each(model, feeds, monkeypatch) -> None:
    together = observe(model, lambda: feeds, tensors=["positive", "y"])
    monkeypatch.setattr("calib.ranges.GROUP_BYTES", 1)
    passes = []

    def start():
        passes.append(1)
        return feeds

    monkeypatch.setattr("calib.ranges.split_groups", lambda names, sizes: split_groups(names, sizes, 10))
    apart = observe(model, start, tensors=["positive", "y"], bytes_of={"positive": 24, "y": 24})
    assert len(passes) == 2
    assert apart.ranges("minmax") == together.ranges("minmax")


def test_groups_hold_the_limit() -> None:
    sizes = {"a": 5, "b": 5, "c": 50, "d": 1}
    assert split_groups(["a", "b", "c", "d"], sizes, 10) == [["a", "b"], ["c"], ["d"]]
    assert split_groups([], sizes, 10) == []


def test_no_frames_is_an_error(model) -> None:
    with pytest.raises(FormatError, match="no frames"):
        observe(model, list, tensors=["y"])


def test_the_cache_gives_back_what_it_took(model, feeds, tmp_path: Path) -> None:
    seen = observe(model, lambda: feeds, tensors=["positive", "y"], channel_tensors=["y"])
    assert load("key", tmp_path) is None
    place = store("key", seen, tmp_path)
    again = load("key", tmp_path)
    assert again is not None
    assert again.frames == seen.frames
    for method in ("minmax", "percentile", "mse", "entropy"):
        assert again.ranges(method) == seen.ranges(method)
    np.testing.assert_array_equal(again.channels["y"][0], seen.channels["y"][0])
    assert [path.name for path in tmp_path.iterdir()] == ["key.npz"]
    assert place is not None
    whole = place.read_bytes()
    torn = whole[:64] + bytes(255 - byte for byte in whole[64:96]) + whole[96:]  # within the first packed array
    for damage in (b"", b"PK\x03\x04 and no more", whole[:-200], torn):
        place.write_bytes(damage)
        assert load("key", tmp_path) is None


def test_a_place_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    taken = tmp_path / "file"
    taken.write_text("in the way", encoding="utf-8")
    assert store("key", Observation({}, {}, 1), taken) is None


def test_a_full_disk_leaves_no_half_file(tmp_path: Path, monkeypatch) -> None:
    def broken_off(stream, **arrays) -> None:
        stream.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez_compressed", broken_off)
    assert store("key", Observation({}, {}, 0), tmp_path) is None
    assert list(tmp_path.iterdir()) == []


def test_old_files_are_forgotten(model, feeds, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("calib.cache._KEPT_FILES", 2)
    seen = observe(model, lambda: feeds, tensors=["y"])
    for number in range(4):
        store(f"key{number}", seen, tmp_path)
    assert len(list(tmp_path.iterdir())) == 2
    assert load("key3", tmp_path) is not None


def test_the_key_depends_on_everything() -> None:
    base = {"geometry_digest": "cameras", "tensors": ["a", "b"], "channel_tensors": ["c"], "view": "crop"}
    keys = {
        cache_key(b"model", "frames", **base),
        cache_key(b"other", "frames", **base),
        cache_key(b"model", "others", **base),
        cache_key(b"model", "frames", **{**base, "geometry_digest": "others"}),
        cache_key(b"model", "frames", **{**base, "tensors": ["a"]}),
        cache_key(b"model", "frames", **{**base, "channel_tensors": []}),
        cache_key(b"model", "frames", **{**base, "view": "another"}),
    }
    assert len(keys) == 7


def test_the_folder_follows_the_users_setting(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "stereo-edge" / "calibration"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert cache_folder() == tmp_path / "home" / ".cache" / "stereo-edge" / "calibration"
