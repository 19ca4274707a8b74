"""Assignment, targets, losses with gradients, priors, augmentation: each equals its recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.presets import preset  # noqa: E402
from edge.training.assign import assign, match_anchors  # noqa: E402
from edge.training.augment import change_colours, draw_colour_change  # noqa: E402
from edge.training.disparity_targets import reduce_to_cells  # noqa: E402
from edge.training.ground_truth import GroundTruth  # noqa: E402
from edge.training.losses import (  # noqa: E402
    ImageTargets,
    box_loss,
    class_loss,
    disparity_loss,
    focal_terms,
    smooth_l1_terms,
)
from edge.training.priors import anchor_statistics  # noqa: E402
from edge.training.schedule import cosine_rate  # noqa: E402
from runtime.anchors import anchor_grid, usable_anchors  # noqa: E402
from runtime.contracts.geometry import StereoGeometry  # noqa: E402
from runtime.contracts.kitti import parse_labels  # noqa: E402
from runtime.contracts.manifest import AnchorLayout, AnchorPriors, read_priors  # noqa: E402
from runtime.preprocess import network_view  # noqa: E402

pytestmark = pytest.mark.torch

CLASSES = ("Car", "Pedestrian")
TARGET_TOLERANCE = 1e-6  # same float32 arithmetic
LOSS_TOLERANCE = 2e-6  # relative; sums of thousands of float32 terms in another order
GRADIENT_TOLERANCE = 1e-6  # of the largest gradient
PRIOR_TOLERANCE = 2e-6  # relative; the recording is float64, the tables float32
NONE = np.zeros((0, 4), np.float32)


@pytest.fixture
def recorded_inputs(golden_module: Callable[[str], ModuleType]) -> ModuleType:
    return golden_module("official/recorded_inputs.py")


@pytest.fixture
def priors(golden_dir: Path) -> AnchorPriors:
    return read_priors(golden_dir / "priors.npz", CLASSES, AnchorLayout())


def truth_of(annotations: np.ndarray) -> GroundTruth:
    rows = annotations[annotations[:, 4] >= 0]
    boxes = np.concatenate([rows[:, :4], rows[:, 5:8], rows[:, 8:12]], axis=1).astype(np.float32)
    return GroundTruth(boxes, rows[:, 4].astype(np.int64), NONE, NONE)


@pytest.mark.parametrize("image", [0, 1])
def test_assignment(golden_dir: Path, priors: AnchorPriors, image: int) -> None:
    recorded = np.load(golden_dir / "assign_targets.npz")
    layout = AnchorLayout()
    grid = anchor_grid(layout, (288, 1280))
    usable = usable_anchors(grid, layout, priors=priors, P2=recorded["P2"])
    truth = truth_of(recorded["annotations"][image])
    index = np.flatnonzero(usable)
    match, background = match_anchors(grid.boxes[index], truth.boxes[:, :4], claim_without_overlap=False)
    hit = np.flatnonzero(match >= 0)
    np.testing.assert_array_equal(index[hit], recorded[f"img{image}_pos_anchor"])
    np.testing.assert_array_equal(match[hit], recorded[f"img{image}_pos_gt"])
    bits = np.unpackbits(recorded[f"img{image}_neg_bits"])[: len(index)].astype(bool)
    np.testing.assert_array_equal(background, bits)

    targets = assign(truth, grid, usable, priors=priors)
    known = recorded[f"img{image}_pos_prior_valid"]
    np.testing.assert_array_equal(targets.positive, index[hit[known]])
    np.testing.assert_allclose(targets.deltas, recorded[f"img{image}_targets"][known], atol=TARGET_TOLERANCE)
    np.testing.assert_array_equal(targets.facing, recorded[f"img{image}_target_facing"][known][:, 0])


def test_object_outside_the_image_claims_everything_only_by_option() -> None:
    boxes = np.array([[0, 0, 10, 10], [20, 0, 30, 10]], np.float32)
    outside = np.array([[500, 500, 510, 510]], np.float32)
    match, background = match_anchors(boxes, outside, claim_without_overlap=False)
    assert list(match) == [-2, -2] and background.all()
    match, background = match_anchors(boxes, outside, claim_without_overlap=True)
    assert list(match) == [0, 0] and not background.any()


def test_head_loss_and_gradients(golden_dir: Path, priors: AnchorPriors, recorded_inputs: ModuleType) -> None:
    recorded = np.load(golden_dir / "loss_head.npz")
    facts = json.loads((golden_dir / "head_and_losses.json").read_text())
    layout = AnchorLayout()
    grid = anchor_grid(layout, (96, 320))
    usable = usable_anchors(grid, layout, priors=priors, P2=recorded["P2"])
    raw = recorded_inputs.head_outputs(21, (2, 5760, 2), logits=(-3, 1.5), facing_shift=0, box_deviation=0.5)
    logits, deltas = (torch.tensor(array, requires_grad=True) for array in raw)
    images = []
    for rows in recorded["annotations"]:
        t = assign(truth_of(rows), grid, usable, priors=priors)
        tensors = (torch.from_numpy(x) for x in (t.label, t.positive, t.deltas, t.facing))
        images.append(ImageTargets(*tensors, t.object_count))
    weights = torch.tensor(preset("paper").training.class_weights)
    classes = class_loss(logits[..., :-1], images, weights)
    boxes = box_loss(logits[..., -1], deltas, images)
    (classes + boxes).backward()
    assert classes.item() == pytest.approx(float(recorded["cls_loss"][0]), rel=LOSS_TOLERANCE)
    assert boxes.item() == pytest.approx(float(recorded["reg_loss"][0]), rel=LOSS_TOLERANCE)
    expected = recorded["cls_grad"]
    assert np.abs(logits.grad.numpy() - expected).max() <= GRADIENT_TOLERANCE * np.abs(expected).max()
    where = tuple(recorded["reg_grad_index"])
    assert np.abs(deltas.grad.numpy()[where] - recorded["reg_grad"]).max() <= GRADIENT_TOLERANCE
    rest = deltas.grad.clone()
    rest[where] = 0
    assert not rest.any()

    empty = ImageTargets(
        torch.zeros_like(images[1].label), images[1].positive[:0], images[1].deltas[:0], images[1].facing[:0], 0
    )
    without = facts["loss_head_second_image_empty"]
    pair = [images[0], empty]
    assert class_loss(logits[..., :-1], pair, weights).item() == pytest.approx(without["cls_loss"], rel=LOSS_TOLERANCE)
    assert box_loss(logits[..., -1], deltas, pair).item() == pytest.approx(without["reg_loss"], rel=LOSS_TOLERANCE)


def test_elementary_losses(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "loss_elementary.npz")
    difference = torch.tensor(recorded["smoothl1_x"], requires_grad=True)
    value = smooth_l1_terms(difference)
    value.sum().backward()
    np.testing.assert_allclose(value.detach(), recorded["smoothl1_value"], atol=1e-7)
    np.testing.assert_allclose(difference.grad, recorded["smoothl1_grad"], atol=1e-6)
    for target in (0.0, 1.0):
        logits = torch.tensor(recorded["focal_x"])[:, None].repeat(1, 2).requires_grad_()
        terms = focal_terms(logits, torch.full_like(logits, target), torch.tensor([20.0, 40.0]))
        terms.sum().backward()
        np.testing.assert_allclose(terms.detach(), recorded[f"focal_t{target:.0f}_value"], rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(logits.grad, recorded[f"focal_t{target:.0f}_grad"], rtol=1e-4, atol=1e-5)


def test_disparity_loss(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "loss_disparity.npz")
    logits = torch.tensor(recorded["logits"], requires_grad=True)
    truth = torch.tensor(recorded["gt"])
    loss = disparity_loss(logits, truth)
    loss.backward()
    assert loss.item() == pytest.approx(float(recorded["loss"]), rel=LOSS_TOLERANCE)
    np.testing.assert_allclose(logits.grad[:, ::8], recorded["grad_every_8th"], atol=1e-8)
    for coefficient in (1, 5):
        value = disparity_loss(logits, truth, focal_coefficient=coefficient).item()
        assert value == pytest.approx(float(recorded[f"loss_focal_coefficient_{coefficient}"]), rel=1e-5)
    assert disparity_loss(logits, truth * 0, valid_only=True).item() == 0


def test_colour_changes(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "data_pipeline.npz")
    for case in range(4):
        change = draw_colour_change(np.random.RandomState(100 + case))
        for side in ("left", "right"):
            ours = change_colours(recorded[f"photo_{side}_in"].astype(np.float32), change)
            np.testing.assert_allclose(ours, recorded[f"photo_out{case}_{side}"], atol=1e-4)


def test_disparity_cells(golden_dir: Path) -> None:
    recorded = np.load(golden_dir / "data_pipeline.npz")
    cells = reduce_to_cells(recorded["bm_disp16"])
    np.testing.assert_array_equal(cells * 16, recorded["bm_reduced_left"])


def test_prior_tables(golden_dir: Path, recorded_inputs: ModuleType) -> None:
    lines: dict[str, list[str]] = {}
    for line in (golden_dir / "priors_labels.txt").read_text().splitlines(keepends=True):
        name, label = line.split(" ", 1)
        lines.setdefault(name, []).append(label)
    geometry = StereoGeometry(recorded_inputs.P2_CAMERA, recorded_inputs.P3_CAMERA, (1242, 375))
    view = network_view(geometry, preset("paper").manifest())
    labelled = [parse_labels("".join(text)) for text in lines.values()]
    frames = [(objects, view.to_network(objects.box_in_left_image)) for objects in labelled]
    tables = anchor_statistics(frames, CLASSES, AnchorLayout(), input_size_hw=(288, 1280))
    expected = np.load(golden_dir / "priors_expected.npz")
    for index, name in enumerate(CLASSES):
        np.testing.assert_allclose(tables.mean[index], expected[f"{name}_mean"], rtol=PRIOR_TOLERANCE, atol=1e-6)
        np.testing.assert_allclose(tables.std[index], expected[f"{name}_std"], rtol=PRIOR_TOLERANCE, atol=1e-6)


def test_learning_rates(golden_dir: Path) -> None:
    expected = json.loads((golden_dir / "head_and_losses.json").read_text())["lr_per_epoch_0_to_80"]
    settings = preset("paper").training
    rates = [
        cosine_rate(epoch, 80, peak=settings.learning_rate, final=settings.final_learning_rate)
        for epoch in range(len(expected))
    ]
    np.testing.assert_allclose(rates, expected, rtol=1e-9)
