"""Priors are found beside a checkpoint, in an npz, or in the official code's files."""

from __future__ import annotations

import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.detector.ablations import ablated
from edge.detector.presets import PRESETS
from edge.zoo.priors import BUNDLED, bundled_priors, find_priors, uses_bundled_priors
from runtime.contracts.errors import CheckpointError, ManifestError
from runtime.contracts.manifest import AnchorPriors, write_priors
from runtime.sources.kitti_object import bundled_split

PAPER = PRESETS["paper"]
SIZE_TOLERANCE = 1e-4  # relative; tables are float32, a mean square less a squared mean in another order
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
        find_priors(PRESETS["compact"], tmp_path / "weights.safetensors", None)
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


@pytest.mark.parametrize("name", BUNDLED)
def test_bundled_tables_where_nothing_lies_beside_the_checkpoint(tmp_path: Path, name: str) -> None:
    chosen, checkpoint = PRESETS[name], tmp_path / "weights.pth"
    assert uses_bundled_priors(chosen, checkpoint, None)
    found = find_priors(chosen, checkpoint, None)
    depth_m = found.mean[0, :, :, 0]  # cars: every shape has been seen, larger ones are nearer
    assert (depth_m > 3).all()
    assert (np.diff(depth_m[:12], axis=0) < 0).all()
    width, height, length = found.mean[0, 0, 0, 3:]
    assert 1.5 < width < 1.8 and 1.4 < height < 1.7 and 3.5 < length < 4.3
    with pytest.raises(CheckpointError, match="found no anchor priors"):
        find_priors(chosen, checkpoint, tmp_path)  # a folder that was named must hold them


def test_bundled_tables_are_for_the_presets_own_anchors_and_classes() -> None:
    assert bundled_priors(PRESETS["compact"]) is None
    assert bundled_priors(ablated(PAPER, ["no-scale-8", "no-anchor-filter"])) is not None
    assert bundled_priors(replace(PAPER, classes=("Car",))) is None
    assert bundled_priors(replace(PAPER, anchors=replace(PAPER.anchors, base_px=20.0))) is None
    assert bundled_priors(replace(PAPER, rig=replace(PAPER.rig, focal_px=2 * PAPER.rig.focal_px))) is None


def test_tables_beside_the_checkpoint_win(tmp_path: Path, priors: AnchorPriors) -> None:
    write_priors(tmp_path / "priors.npz", PAPER.classes, priors)
    assert not uses_bundled_priors(PAPER, tmp_path / "weights.pth", None)


def test_bundled_tables_are_the_train_labels(kitti_dir: Path, tmp_path: Path) -> None:
    """Sizes of all counted cars of the train side, computed here by plain means."""
    with tarfile.open(kitti_dir / "labels_and_splits.tar.xz") as archive:
        members = [item for item in archive if item.name.startswith("label_2/")]
        wanted = {f"label_2/{stem}.txt" for stem in bundled_split("train")}
        texts = [archive.extractfile(item).read().decode() for item in members if item.name in wanted]  # type: ignore[union-attr]
    assert len(texts) == 3712
    rows = [line.split() for text in texts for line in text.splitlines()]
    counted = [row for row in rows if row[0] == "Car" and int(row[2]) < 2 and float(row[13]) > 3]
    sizes = np.array([[float(row[column]) for column in (9, 8, 10)] for row in counted])
    for name in BUNDLED:
        found = find_priors(PRESETS[name], tmp_path / "weights.pth", None)
        np.testing.assert_allclose(found.mean[0, 0, 0, 3:], sizes.mean(axis=0), rtol=SIZE_TOLERANCE)
        np.testing.assert_allclose(found.std[0, 0, 0, 3:], sizes.std(axis=0), rtol=SIZE_TOLERANCE)


@pytest.mark.torch
@pytest.mark.parametrize("name", BUNDLED)
def test_a_run_takes_the_bundled_table_where_none_is_given(tmp_path: Path, name: str) -> None:
    pytest.importorskip("torch", reason="the torch workbench is not installed")
    from edge.training.start import keep_priors, run_priors

    found = run_priors(tmp_path, PRESETS[name], [], given=None)
    expected = find_priors(PRESETS[name], tmp_path / "elsewhere" / "weights.pth", None)
    np.testing.assert_array_equal(found.mean, expected.mean)
    keep_priors(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["priors.npz"]  # the run keeps them beside its weights
    np.testing.assert_array_equal(run_priors(tmp_path, PRESETS[name], [], given=None).std, expected.std)
