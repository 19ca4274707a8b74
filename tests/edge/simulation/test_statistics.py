"""The simulated world against KITTI's train-side label files: 500 default frames from seed 1,000,000.

Labels whose occlusion KITTI calls unknown are left out of shares and histograms (every simulated label knows its own),
not out of the counts. The last depth bin is open.
"""

from __future__ import annotations

import tarfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from edge.simulation.label_sets import labels_of_seeds
from edge.simulation.label_statistics import (
    CLASSES,
    UNKNOWN_OCCLUSION,
    LabelTable,
    difficulty,
    summarise,
    tabulate,
    train_statistics,
)
from runtime.contracts.errors import MissingExtraError
from runtime.contracts.kitti import parse_labels

FIRST_SEED, FRAMES = 1_000_000, 500
CONTRACT = 0.20  # a simulated share or count against that of the train labels
DEPTH_EDGES_M = (-20.0, 10.0, 20.0, 30.0, 40.0, 50.0, 200.0)


@pytest.fixture(scope="module")
def real(shared_dir: Path) -> LabelTable:
    path = shared_dir / "kitti" / "labels_and_splits.tar.xz"
    if not path.is_file():
        pytest.skip("KITTI's label files are not on this machine")
    with tarfile.open(path) as archive:
        texts = {
            member.name: archive.extractfile(member).read().decode()  # type: ignore[union-attr]
            for member in archive
            if (member.name.startswith("label_2/") and member.isfile()) or member.name == "ImageSets/train.txt"
        }
    names = texts["ImageSets/train.txt"].split()
    assert len(names) == 3712
    return tabulate(parse_labels(texts[f"label_2/{name}.txt"]) for name in names)


@pytest.fixture(scope="module")
def simulated() -> LabelTable:
    try:
        return tabulate(labels_of_seeds(range(FIRST_SEED, FIRST_SEED + FRAMES)))
    except MissingExtraError as error:
        pytest.skip(str(error))


def _rows(table: LabelTable, kind: str) -> NDArray[np.bool_]:
    known = table.occlusion < UNKNOWN_OCCLUSION
    return known if kind == "all" else known & (table.kind == CLASSES.index(kind))


def _difficulty_shares(table: LabelTable, rows: NDArray[np.bool_]) -> NDArray[np.float64]:
    level = difficulty(table)[rows]
    return np.array([(level <= hardest).mean() for hardest in range(3)])


def _depth_shares(table: LabelTable, rows: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.histogram(table.z_m[rows], DEPTH_EDGES_M)[0] / rows.sum()


def _occlusion_shares(table: LabelTable, rows: NDArray[np.bool_]) -> NDArray[np.float64]:
    return np.bincount(table.occlusion[rows], minlength=3) / rows.sum()


def test_the_summary_in_the_tree_is_that_of_the_labels(real: LabelTable) -> None:
    assert summarise(real) == train_statistics()


@pytest.mark.slow
def test_objects_a_frame_by_class(real: LabelTable, simulated: LabelTable) -> None:
    counts = [np.bincount(table.kind, minlength=len(CLASSES)) / table.frames for table in (simulated, real)]
    assert counts[0] == pytest.approx(counts[1], rel=CONTRACT), CLASSES


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["all", "Car"])
@pytest.mark.parametrize("shares", [_difficulty_shares, _depth_shares, _occlusion_shares])
def test_shares_and_histograms(real: LabelTable, simulated: LabelTable, kind: str, shares) -> None:  # type: ignore[no-untyped-def]
    assert shares(simulated, _rows(simulated, kind)) == pytest.approx(shares(real, _rows(real, kind)), rel=CONTRACT)
