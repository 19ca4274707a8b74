"""Priors are found beside a checkpoint, in an npz, or in the official code's files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edge.detector.presets import PRESETS
from edge.zoo.priors import find_priors
from runtime.contracts.errors import CheckpointError, ManifestError
from runtime.contracts.manifest import AnchorPriors, write_priors

PAPER = PRESETS["paper"]
SHAPE = (len(PAPER.classes), PAPER.anchors.scale_count, len(PAPER.anchors.ratios), 6)


@pytest.fixture
def priors() -> AnchorPriors:
    mean, std = np.random.default_rng(0).uniform(1, 30, (2, *SHAPE)).astype(np.float32)
    return AnchorPriors(mean, std)


def write_official(folder: Path, priors: AnchorPriors) -> None:
    for index, name in enumerate(PAPER.classes):
        np.save(folder / f"anchor_mean_{name}.npy", priors.mean[index].astype(np.float64))
        np.save(folder / f"anchor_std_{name}.npy", priors.std[index].astype(np.float64))


def test_none_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="found no anchor priors"):
        find_priors(PAPER, tmp_path / "weights.safetensors", None)
    with pytest.raises(CheckpointError, match="found no anchor priors"):
        find_priors(PAPER, tmp_path / "weights.safetensors", tmp_path / "nowhere")


def test_beside_the_checkpoint_as_a_file_and_in_a_folder(tmp_path: Path, priors: AnchorPriors) -> None:
    write_priors(tmp_path / "priors.npz", PAPER.classes, priors)
    elsewhere = Path("elsewhere") / "weights.safetensors"
    for checkpoint, given in (
        (tmp_path / "weights.safetensors", None),
        (elsewhere, tmp_path),
        (elsewhere, tmp_path / "priors.npz"),
    ):
        found = find_priors(PAPER, checkpoint, given)
        np.testing.assert_array_equal(found.mean, priors.mean)
        np.testing.assert_array_equal(found.std, priors.std)


def test_official_files(tmp_path: Path, priors: AnchorPriors) -> None:
    write_official(tmp_path, priors)
    found = find_priors(PAPER, tmp_path / "weights.pth", None)
    assert found.mean.dtype == np.float32
    np.testing.assert_array_equal(found.mean, priors.mean)
    np.testing.assert_array_equal(found.std, priors.std)


def test_official_files_of_another_preset(tmp_path: Path, priors: AnchorPriors) -> None:
    write_official(tmp_path, AnchorPriors(priors.mean[:, :8], priors.std[:, :8]))
    with pytest.raises(CheckpointError, match=r"found shape \(8, 3, 6\)"):
        find_priors(PAPER, tmp_path / "weights.pth", tmp_path)


def test_official_file_that_is_missing_or_a_pickle(tmp_path: Path, priors: AnchorPriors) -> None:
    write_official(tmp_path, priors)
    broken = tmp_path / "anchor_std_Pedestrian.npy"
    for make in (
        lambda: np.save(broken, np.array([object()], dtype=object), allow_pickle=True),
        lambda: broken.write_bytes(b""),
        broken.unlink,
    ):
        make()
        with pytest.raises(CheckpointError, match=r"anchor_std_Pedestrian\.npy: found that it cannot be read"):
            find_priors(PAPER, tmp_path / "weights.pth", tmp_path)


def test_npz_of_another_preset(tmp_path: Path, priors: AnchorPriors) -> None:
    write_priors(tmp_path / "priors.npz", PAPER.classes, priors)
    with pytest.raises(ManifestError):
        find_priors(PRESETS["compact"], tmp_path / "weights.safetensors", None)
