"""Two processes that `torchrun` starts equal one process with the joint batch."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.training.distributed import ALONE, Ranks, joint_sum, ranks_of_environment, share_of_denominator  # noqa: E402
from edge.training.stream import Positions  # noqa: E402
from runtime.contracts.errors import EdgeError  # noqa: E402

pytestmark = pytest.mark.torch

WORKER = Path(__file__).with_name("two_process_worker.py")
REPOSITORY = Path(__file__).resolve().parents[3]
TOLERANCE = 1e-5  # sums of float32 in another order; of the largest value of its kind and step
SECONDS = 120


def test_alone_without_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK"):
        monkeypatch.delenv(name, raising=False)
    assert ranks_of_environment() == ALONE
    assert joint_sum({"objects": 3.0}, ALONE, torch.device("cpu")) == {"objects": 3.0}
    assert share_of_denominator(2.0, 2.0, ALONE) == 1.0


def test_a_batch_that_cannot_be_shared_is_one_line() -> None:
    with pytest.raises(EdgeError, match="expected a multiple"):
        Ranks(0, 3).share_of(4)


def test_processes_share_each_step_and_nothing_twice() -> None:
    shares = [list(Positions(2, 4, batch_size=6, ranks=Ranks(rank, 3))) for rank in range(3)]
    assert shares == [[12, 13, 18, 19], [14, 15, 20, 21], [16, 17, 22, 23]]
    assert list(Positions(2, 4, batch_size=6, ranks=ALONE)) == list(range(12, 24))


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_two_processes_equal_one_with_the_joint_batch(toy: ModuleType, tmp_path: Path) -> None:
    alone, together = tmp_path / "alone", tmp_path / "together"
    for folder in (alone, together):
        folder.mkdir()
    toy.run(alone)
    launch = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", str(WORKER), str(together)]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY), "OMP_NUM_THREADS": "1"}
    ran = subprocess.run(
        [sys.executable, *launch], env=environment, capture_output=True, text=True, check=False, timeout=SECONDS
    )
    assert ran.returncode == 0, ran.stderr
    for name in (*toy.METHODS, toy.EMPTY):
        compare(toy, alone / name, together / name)


def compare(toy: ModuleType, alone: Path, together: Path) -> None:
    expected = np.load(alone / "result-0-of-1.npz")
    for rank in range(2):
        found = np.load(together / f"result-{rank}-of-2.npz")
        assert set(found.files) == set(expected.files)
        for kind in ("loss", "gradient", "parameter"):
            for step in range(1, toy.STEPS + 1):
                names = [name for name in expected.files if name.startswith(f"{kind}/{step}/")]
                assert names
                largest = max(np.abs(expected[name]).max() for name in names)
                difference = {name: np.abs(found[name] - expected[name]).max() for name in names}
                worst = max(difference, key=lambda name: difference[name])
                assert difference[worst] <= TOLERANCE * largest, (rank, worst)
    moved = [
        name
        for name in expected.files
        if name.startswith("parameter/1/") and not np.array_equal(expected[name], expected[name.replace("/1/", "/3/")])
    ]
    assert any("backbone" in name for name in moved)
    assert any("disparity_branch" in name for name in moved) == (alone.name != toy.EMPTY)  # no objects, no disparity
    # the first process alone writes
    written = sorted(path.name for path in together.iterdir())
    assert written == ["checkpoint.pt", "events", "log.csv", "result-0-of-2.npz", "result-1-of-2.npz"]
    assert (together / "log.csv").read_text().count("\n") == 1 + toy.STEPS
