"""Each option of training changes what it says, and the two named sets hold what the paper and the official code do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.presets import Preset, PresetError, preset  # noqa: E402
from edge.detector.weights import save_weights  # noqa: E402
from edge.training.losses import ImageTargets, box_loss, class_loss, disparity_loss, valid_pixels  # noqa: E402
from edge.training.methods import METHODS, with_method, with_method_of  # noqa: E402
from edge.training.point_clouds import points_in_camera  # noqa: E402
from edge.training.samples import Sample, SampleMaker  # noqa: E402
from runtime.contracts.errors import FormatError, FrameError, SourceError  # noqa: E402
from runtime.sources.factory import open_sequence  # noqa: E402

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]


class FixedDraws(np.random.RandomState):
    """A generator whose every draw of a probability is the same: 0.1 mirrors, 0.9 does not."""

    def __new__(cls, value: float) -> FixedDraws:
        return super().__new__(cls, 0)

    def __init__(self, value: float) -> None:
        super().__init__(0)
        self._value = value

    def rand(self, *_: int) -> float:  # type: ignore[override]
        return self._value


@pytest.fixture
def sample(toy: ModuleType) -> Callable[..., Sample]:
    """Makes one sample of a textured pair whose right view is the left one shifted by 24 pixels."""

    def make(*, mirrored: bool = False, points: Any = None, chosen: Preset | None = None, **options: Any) -> Sample:
        base = chosen or toy.tiny_preset()
        base = replace(base, training=replace(base.training, **options))
        frame = toy.DrawnFrames()[0]
        frame = replace(frame, right=np.roll(frame.left, -24, axis=1))
        maker = SampleMaker(base, toy.plain_priors(base))
        draws = FixedDraws(0.1 if mirrored else 0.9)
        return maker.make(frame, toy.DrawnFrames().labels(0), draws, points_in_camera=points)

    return make


def test_unknown_method() -> None:
    with pytest.raises(PresetError, match="expected one of paper, official"):
        with_method(preset("paper"), "best")


def test_methods_differ_in_every_option_they_name() -> None:
    assert METHODS["paper"].keys() == METHODS["official"].keys()
    paper, official = (with_method(preset("paper"), name) for name in ("paper", "official"))
    for name in METHODS["paper"]:
        assert getattr(paper.training, name) != getattr(official.training, name), name
    assert paper.anchors.filter_by_class and not official.anchors.filter_by_class
    assert (paper.training.epochs, official.training.epochs) == (50, 80)
    assert paper.manifest().anchors.filter_by_class  # the model keeps the filter it was trained with


def test_export_takes_the_method_that_the_weights_name(tmp_path: Path) -> None:
    paper = preset("paper")
    for name, expected in (("paper", True), ("official", False), ("preset", False)):
        file = tmp_path / f"{name}.safetensors"
        save_weights(file, {"weight": torch.zeros(2)}, metadata={"method": name})
        assert with_method_of(paper, file).anchors.filter_by_class is expected
    assert with_method_of(paper, tmp_path / "Stereo3D_latest.pth") == paper


def test_disparity_source_none(sample: Callable[..., Sample]) -> None:
    assert sample().disparity.any()  # type: ignore[union-attr]
    assert not sample(disparity_source="none").disparity.any()  # type: ignore[union-attr]


def test_disparity_source_points(sample: Callable[..., Sample]) -> None:
    with pytest.raises(FrameError, match="has no points"):
        sample(disparity_source="points")
    points = np.array([[5.0, 1.0, 20.0]])
    cells = {flag: sample(disparity_source="points", points=points, mirrored=flag).disparity for flag in (False, True)}
    for flag, found in cells.items():
        (row,), (column,) = np.nonzero(found)
        # network focal length 260 px, baseline 0.53 m, in sixteenths rounded down
        assert found[row, column] == pytest.approx(260 * 0.5327 / 20.0, abs=1 / 16), flag
    assert np.nonzero(cells[False])[1] > np.nonzero(cells[True])[1]


def test_mirrored_disparity(sample: Callable[..., Sample]) -> None:
    plain = sample().disparity
    matched = sample(mirrored=True).disparity
    official = sample(mirrored=True, mirrored_disparity="official").disparity
    np.testing.assert_array_equal(official, plain[:, ::-1])  # type: ignore[index]
    assert not np.array_equal(official, matched)  # type: ignore[arg-type]
    assert sample(mirrored_disparity="official").disparity == pytest.approx(plain)


def test_grey_changes_the_match(sample: Callable[..., Sample]) -> None:
    assert not np.array_equal(sample().disparity, sample(matching_grey="official").disparity)  # type: ignore[arg-type]


def test_filter_by_class_ignores_positives_off_their_ground(toy: ModuleType) -> None:
    base = toy.tiny_preset()
    priors = toy.plain_priors(base)
    priors.mean[0, ..., 0] = 2000.0  # cars of that depth stand nowhere near the ground; other classes keep the anchors
    frame, objects = toy.DrawnFrames()[0], toy.DrawnFrames().labels(0)
    found = {}
    for flag in (False, True):
        chosen = replace(base, anchors=replace(base.anchors, filter_by_class=flag))
        found[flag] = SampleMaker(chosen, priors).make(frame, objects, np.random.RandomState(0)).targets
    assert len(found[False].positive) > len(found[True].positive)
    gone = np.setdiff1d(found[False].positive, found[True].positive)
    assert (found[True].label[gone] == -1).all()


def targets(count: int) -> ImageTargets:
    label = torch.zeros(8, dtype=torch.int8)
    positive = torch.arange(count)
    label[:count] = 1
    return ImageTargets(label, positive, torch.zeros(count, 12), torch.ones(count), count)


def test_dead_zones() -> None:
    logits, weights = torch.full((1, 8, 1), -9.0), torch.ones(1)
    some = [targets(1)]
    logits[0, 0] = 9.0
    assert class_loss(logits, some, weights).item() == 0
    assert class_loss(logits, some, weights, dead_zone=False).item() > 0
    facing, deltas = torch.full((1, 8), 30.0), torch.full((1, 8, 12), 0.009)
    assert box_loss(facing, deltas, some).item() == pytest.approx(0, abs=1e-9)
    assert box_loss(facing, deltas, some, dead_zone=False).item() > 1e-4


def test_background_of_an_empty_image() -> None:
    logits, weights = torch.zeros(1, 8, 1), torch.ones(1)
    assert class_loss(logits, [targets(0)], weights).item() == 0
    assert class_loss(logits, [targets(0)], weights, empty_images_teach=True).item() > 0


def test_valid_pixels_only() -> None:
    logits, truth = torch.zeros(1, 96, 2, 2), torch.tensor([[[5.0, 0.0], [0.0, 200.0]]])
    everywhere = disparity_loss(logits, truth).item()
    assert valid_pixels(truth, 96) == 1
    assert disparity_loss(logits, truth, valid_only=True).item() == pytest.approx(4 * everywhere)
    assert disparity_loss(logits, truth, focal_coefficient=5.0).item() > everywhere


def test_points_of_a_kitti_folder(tiny_drive: Path) -> None:
    with open_sequence(f"kitti-object:{tiny_drive}") as source:
        with pytest.raises(SourceError, match="is missing"):
            points_in_camera(source, 0)
        folder = tiny_drive / "training" / "velodyne"
        folder.mkdir()
        cloud = folder / "000000.bin"
        cloud.write_bytes(b"123")
        with pytest.raises(FormatError, match="expected 16 a point"):
            points_in_camera(source, 0)
        np.array([[20, -5, 1, 0.3]], np.float32).tofile(cloud)
        calibration = tiny_drive / "training" / "calib" / "000000.txt"
        text = "".join(line + "\n" for line in calibration.read_text().splitlines() if line.startswith("P"))
        calibration.write_text(text)
        with pytest.raises(FormatError, match="has no R0_rect"):
            points_in_camera(source, 0)
        calibration.write_text(text + "R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0 0 0 -1 -0.08 1 0 0 -0.27\n")
        np.testing.assert_allclose(points_in_camera(source, 0), [[5, -1.08, 19.73]])
