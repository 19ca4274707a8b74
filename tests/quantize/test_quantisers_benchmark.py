"""The comparison of quantisers (`tests/benchmarks/quantisers.py`) on the toy network: rows, resuming, failing peers."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

pytest.importorskip("onnx")

from runtime.contracts.errors import SourceError
from runtime.contracts.manifest import open_model_directory
from runtime.sources.factory import open_sequence

REPOSITORY = Path(__file__).resolve().parents[2]
FRAMES = 2


@pytest.fixture
def quantisers(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The benchmark, which no package holds."""
    monkeypatch.syspath_prepend(str(REPOSITORY))
    return importlib.import_module("tests.benchmarks.quantisers")


@pytest.fixture
def bench(quantisers: ModuleType, toy_directory: Path, tiny_drive: Path, tmp_path: Path) -> Any:
    uri = f"kitti-object:{tiny_drive}"
    control = quantisers.Control(
        quantisers.narrowed(uri, 1, shift=4), max_disagreement=2.0, ranking_frames=1, max_layers=1
    )
    job = quantisers.Job(open_model_directory(toy_directory), quantisers.narrowed(uri, FRAMES), FRAMES, control)
    out = tmp_path / "out"
    out.mkdir()
    return quantisers.Bench(job, uri, out)


def test_no_more_frames_than_there_are(quantisers, tiny_drive) -> None:
    with pytest.raises(SourceError, match="found 4 frames; expected 5"):
        quantisers.narrowed(f"kitti-object:{tiny_drive}", 5)


@pytest.mark.parametrize(
    ("options", "wanted", "shift", "ids"),
    [
        ("", 4, 0, ["000000", "000001", "000002", "000003"]),
        ("", 2, 0, ["000000", "000002"]),
        ("", 2, 4, ["000001", "000003"]),  # half a step beside
        ("?start=1&step=2", 1, 0, ["000001"]),  # on top of what the URI says
        ("?start=1&step=2", 1, 4, ["000003"]),
    ],
)
def test_the_same_frames_for_all(quantisers, tiny_drive, options, wanted, shift, ids) -> None:
    with open_sequence(quantisers.narrowed(f"kitti-object:{tiny_drive}{options}", wanted, shift=shift)) as source:
        assert [source.frame_id(index) for index in range(len(source))] == ids


@pytest.mark.parametrize(("frames", "chunk"), [(1, 1), (7, 7), (48, 8), (50, 5), (100, 5), (53, 1)])
def test_chunks_leave_no_remainder(quantisers, frames, chunk) -> None:
    peers = importlib.import_module("tests.benchmarks.quantisers_peers")
    assert peers.largest_chunk(frames) == chunk


def test_a_peer_is_quantised_measured_timed_and_kept(quantisers, bench, monkeypatch) -> None:
    name = "ort-minmax"
    bench.quantise(name)
    bench.measure([name])
    reference, row = bench.rows(timed_frames=1)
    assert row.error is None
    assert 0 < row.share <= 1
    assert row.ratio > 0
    assert reference.ratio == 1
    assert 0 <= row.matched_share <= 1
    assert open_model_directory(bench.out / name).manifest.recipe == "onnxruntime-minmax"

    def refuse(job: Any, out: Path) -> None:
        raise AssertionError("made twice")

    kept = bench.kept(name)
    monkeypatch.setitem(quantisers.PEERS, name, quantisers.replace(quantisers.PEERS[name], make=refuse))
    bench.quantise(name)
    bench.measure([name])
    assert bench.kept(name) == kept
    bench.quantise(name, again=True)
    assert bench.kept(name).error == "AssertionError: made twice"


def test_a_peer_that_fails_gets_a_row_with_its_reason(quantisers, bench, monkeypatch) -> None:
    def fail(job: Any, out: Path) -> None:
        raise RuntimeError("no such operator\nsecond line")

    monkeypatch.setitem(quantisers.PEERS, "nncf", quantisers.replace(quantisers.PEERS["nncf"], make=fail))
    bench.quantise("nncf")
    bench.measure(["nncf"])
    rows = bench.rows(timed_frames=0)
    table = quantisers.comparison_table(rows, calibrated_on="two frames")
    assert table.columns[-1] == "why not"
    assert table.rows[1][-1] == "RuntimeError: no such operator"
    assert set(table.rows[1][1:-1]) == {"-"}
    assert json.loads((bench.out / "nncf.json").read_text(encoding="utf-8"))["row"]["error"] == table.rows[1][-1]


def test_another_model_makes_records_void(quantisers, bench) -> None:
    bench.keep("edge", quantisers.Row("edge", "none", error="some"))
    assert bench.kept("edge") is not None
    other = quantisers.replace(bench.job.model.manifest, sha256={"model.onnx": "another"})
    job = quantisers.replace(bench.job, model=quantisers.replace(bench.job.model, manifest=other))
    assert quantisers.replace(bench, job=job).kept("edge") is None


@pytest.mark.parametrize("name", ["nncf", "nncf-control"])
@pytest.mark.filterwarnings("default")  # of a foreign package
def test_nncf_gives_a_model_that_our_runtime_runs(bench, name) -> None:
    pytest.importorskip("nncf", reason="nncf is not installed; pip install '.[benchmark]'")
    bench.quantise(name)
    bench.measure([name])
    _, row = bench.rows(timed_frames=0)
    assert row.error is None
    assert 0 < row.share < 1  # it leaves convolutions float that ONNX Runtime could fuse


def test_our_own_quantiser_runs_as_a_user_runs_it(bench, monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    bench.quantise("edge-minmax")
    assert bench.kept("edge-minmax").error is None
    assert open_model_directory(bench.out / "edge-minmax").manifest.recipe.startswith("static_")
