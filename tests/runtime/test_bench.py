"""Benchmarks: every model takes its turns, and the figures add up. No test here judges a speed."""

from __future__ import annotations

import pytest

from runtime.bench import bench_models, profile_directory
from runtime.contracts.errors import ManifestError, RigError, SessionError, SourceError
from runtime.detector import STAGES
from runtime.profile import by_operator, int8_share, node_times, profile_model
from runtime.sources.factory import open_source
from runtime.turns import TOTAL, resident_mib, spread


@pytest.fixture
def frames(tiny_drive):
    with open_source(f"kitti-object:{tiny_drive}") as source:
        return list(source)


def test_each_model_is_timed_alike(tiny_model, frames) -> None:
    told: list[tuple[int, int]] = []
    first, second = bench_models([tiny_model, tiny_model], frames, repeat=2, progress=lambda *step: told.append(step))
    assert first.ratio == 1.0
    assert second.ratio > 0
    assert first.runs == second.runs == 2 * len(frames)
    assert told[-1] == (8, 8)
    assert set(first.stages) == {*STAGES, TOTAL}
    for item in (first, second):
        assert item.recipe == "float32"
        assert item.start_up_ms > item.stages["inference"].low > 0
        for value in item.stages.values():
            assert value.low <= value.median <= value.high


def test_spread_of_samples() -> None:
    assert spread([3.0]) == spread([3.0, 3.0])
    found = spread(list(range(101)))
    assert (found.low, found.median, found.high) == (10.0, 50.0, 90.0)


def test_nothing_to_time_is_refused(tiny_model, frames, tmp_path) -> None:
    with pytest.raises(SourceError, match="no frames"):
        bench_models([tiny_model], [])
    with pytest.raises(SessionError, match="repeat 0"):
        bench_models([tiny_model], frames, repeat=0)
    with pytest.raises(SessionError, match="0 models"):
        bench_models([], frames)
    with pytest.raises(ManifestError):
        bench_models([tmp_path / "nowhere"], frames)


def test_a_camera_of_another_rig_is_refused(tiny_model, tiny_drive) -> None:
    for path in (tiny_drive / "training" / "calib").iterdir():
        path.write_text(path.read_text(encoding="utf-8").replace("2.0000", "4.0000"), encoding="utf-8")
    with open_source(f"kitti-object:{tiny_drive}") as source:
        others = list(source)
    with pytest.raises(RigError):
        bench_models([tiny_model], others)
    assert bench_models([tiny_model], others, repeat=1, allow_other_rig=True)[0].runs == len(others)


def test_the_profile_names_every_node(tiny_model, frames) -> None:
    nodes = profile_directory(tiny_model, frames[:2])
    sums = by_operator(nodes)
    assert {"Cast", "Mul"} <= {item.operator for item in sums}
    assert sum(item.ms for item in sums) == pytest.approx(sum(node.ms for node in nodes))
    assert [item.ms for item in sums] == sorted((item.ms for item in sums), reverse=True)
    assert int8_share(nodes) == 0.0


def test_a_profile_without_inputs_is_refused(tiny_model) -> None:
    with pytest.raises(SessionError, match="no inputs"):
        profile_model(tiny_model / "model.onnx", [])


def event(name: str, operator: str, microseconds: int, inputs: list[list[int]], output: list[int]) -> dict:
    return {
        "cat": "Node",
        "name": f"{name}_kernel_time",
        "dur": microseconds,
        "args": {
            "op_name": operator,
            "node_index": name,
            "input_type_shape": [{"uint8": shape} for shape in inputs],
            "output_type_shape": [{"uint8": output}],
        },
    }


def test_multiply_adds_and_times_from_events() -> None:
    convolution = event("conv", "Conv", 1000, [[1, 3, 8, 8], [16, 3, 3, 3]], [1, 16, 8, 8])
    quantised = event("qconv", "QLinearConv", 2000, [[1, 8, 8, 8], [], [], [4, 8, 1, 1]], [1, 4, 8, 8])
    volume = event("volume", "QLinearStereoCorrelation", 500, [[1, 8, 4, 6]], [1, 5, 4, 6])
    other = {"cat": "Session", "name": "model_run", "dur": 9999}
    runs = [convolution, quantised, volume, other] * 3
    nodes = {node.name: node for node in node_times(runs, runs=2, skipped_runs=1)}
    assert set(nodes) == {"conv", "qconv", "volume"}
    assert nodes["conv"].ms == pytest.approx(1.0)
    assert nodes["conv"].multiply_adds == 16 * 64 * 27
    assert nodes["qconv"].multiply_adds == 4 * 64 * 8
    assert nodes["volume"].multiply_adds == 5 * 4 * 6 * 8
    in_8_bits = 4 * 64 * 8 + 5 * 4 * 6 * 8
    assert int8_share(nodes.values()) == pytest.approx(in_8_bits / (in_8_bits + 16 * 64 * 27))


def test_a_packed_weight_counts_as_unknown() -> None:
    packed = event("qconv", "QLinearConv", 10, [[1, 8, 8, 8], [], [], [4], [4]], [1, 4, 8, 8])
    assert node_times([packed], runs=1)[0].multiply_adds == 0


def test_no_events_no_nodes() -> None:
    assert node_times([], runs=1) == []
    assert int8_share([]) == 0.0


def test_memory_counts_pages_of_the_systems_size(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr("runtime.turns._PROC_STATM", tmp_path / "statm")
    assert resident_mib() is None
    (tmp_path / "statm").write_text("9 2 1 1 0 1 0\n", encoding="ascii")
    monkeypatch.setattr("os.sysconf", {"SC_PAGE_SIZE": 65536}.__getitem__)
    assert resident_mib() == 0.125
