"""Each ablation changes what it says: channels, modules, parameters, anchors, depth."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.ablations import ABLATIONS, ablated  # noqa: E402
from edge.detector.blocks import BasicBlock, GhostExpansion  # noqa: E402
from edge.detector.build import build_detector  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import Preset, PresetError, preset  # noqa: E402
from edge.detector.weights import check_ablations, save_weights  # noqa: E402
from edge.training.assign import assign  # noqa: E402
from edge.training.ground_truth import GroundTruth  # noqa: E402
from runtime.anchors import anchor_grid, usable_by_class  # noqa: E402
from runtime.contracts.errors import CheckpointError  # noqa: E402
from runtime.contracts.manifest import AnchorPriors  # noqa: E402

pytestmark = pytest.mark.torch

NECK = ("no-channel-expansion", "naive-channel-expansion", "no-scale-8", "no-scale-16")
SIZE_HW = (32, 128)


def on_meta(chosen: Preset) -> StereoDetector:
    with torch.device("meta"):
        built = build_detector(chosen)
    assert isinstance(built, StereoDetector)
    return built


def parameters(chosen: Preset, begins: str = "") -> int:
    return sum(value.numel() for name, value in on_meta(chosen).named_parameters() if name.startswith(begins))


def names_of(items: Iterable[str], part: str) -> list[str]:
    return [name for name in items if part in name]


def test_no_ablation_is_the_preset_itself() -> None:
    assert ablated(preset("paper"), []) is preset("paper")


def test_an_unknown_ablation_is_refused() -> None:
    with pytest.raises(PresetError, match="no-scale-8"):
        ablated(preset("paper"), ["no-scale-4"])


@pytest.mark.parametrize("name", NECK)
def test_a_preset_without_a_neck_has_nothing_to_ablate_there(name: str) -> None:
    with pytest.raises(PresetError, match="no stereo neck"):
        ablated(preset("mono"), [name])


@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_changes_one_thing_and_says_so(name: str) -> None:
    base = preset("paper")
    changed = ablated(base, [name])
    assert changed.name == f"paper+{name}"
    parts = ("network", "anchors", "training")
    assert [getattr(changed, part) != getattr(base, part) for part in parts].count(True) == 1
    assert replace(changed, name=base.name, **{part: getattr(base, part) for part in parts}) == base


def test_the_paper_tripled_channels_by_ghost_modules() -> None:
    neck = preset("paper").network.neck
    assert neck is not None and neck.widths == (3 * 24, 3 * (72 + 24), 3 * (288 + 96))


def test_without_expansion_channels_stay() -> None:
    chosen = ablated(preset("paper"), ["no-channel-expansion"])
    detector = on_meta(chosen)
    assert chosen.network.neck is not None and chosen.network.neck.widths == (24, 48, 144)
    assert isinstance(detector.neck.sixteen.ghost, BasicBlock)
    assert detector.head.classification[0].in_channels == 256 + 144  # stereo features weigh less in the head
    assert parameters(chosen) < parameters(preset("paper"))


def test_naive_expansion_is_one_convolution() -> None:
    chosen = ablated(preset("paper"), ["naive-channel-expansion"])
    detector = on_meta(chosen)
    for stage in (detector.neck.four_to_eight, detector.neck.eight_to_sixteen, detector.neck.sixteen):
        convolutions = [module for module in stage.ghost.modules() if isinstance(module, torch.nn.Conv2d)]
        assert [(one.kernel_size, one.out_channels // one.in_channels) for one in convolutions] == [((1, 1), 3)]
        assert not isinstance(stage.ghost, GhostExpansion)
    assert parameters(chosen, "head.") == parameters(preset("paper"), "head.")  # as wide as with ghost modules


def test_scale_8_is_absent() -> None:
    chosen = ablated(preset("paper"), ["no-scale-8"])
    assert on_meta(chosen).neck.eight_to_sixteen.ghost.primary[0].in_channels == 72
    assert on_meta(preset("paper")).neck.eight_to_sixteen.ghost.primary[0].in_channels == 72 + 24


def test_scale_16_is_absent() -> None:
    chosen = ablated(preset("paper"), ["no-scale-16"])
    detector = on_meta(chosen)
    assert names_of(on_meta(preset("paper")).state_dict(), "concat_volume")
    assert names_of(detector.state_dict(), "concat_volume") == []
    assert detector.neck.sixteen.ghost.primary[0].in_channels == 288


@pytest.mark.parametrize("names", [*[(name,) for name in NECK], ("no-channel-expansion", "no-scale-8", "no-scale-16")])
def test_ablated_networks_compute(names: tuple[str, ...]) -> None:
    chosen = ablated(preset("compact"), names)
    detector = build_detector(chosen).eval()
    left, right = torch.randn(2, 1, 3, *SIZE_HW).unbind()
    with torch.no_grad():
        logits, deltas, disparity = detector.forward_training(left, right)
    anchors = SIZE_HW[0] * SIZE_HW[1] // 256 * chosen.anchors.per_cell
    assert logits.shape == (1, anchors, len(chosen.classes) + 1) and deltas.shape == (1, anchors, 12)
    assert disparity is not None and disparity.shape[-2:] == (SIZE_HW[0] // 4, SIZE_HW[1] // 4)


def test_the_right_view_reaches_the_ablated_head_through_the_scales_that_are_left() -> None:
    chosen = ablated(preset("compact"), ["no-scale-8", "no-scale-16"])
    detector = build_detector(chosen).eval()
    left, right = torch.randn(2, 1, 3, *SIZE_HW).unbind()
    with torch.no_grad():
        first, _ = detector.features(left, right)
        second, _ = detector.features(left, right.flip(-1))
    assert not torch.equal(first, second)


def test_without_the_prior_targets_are_depths_alone() -> None:
    base = preset("paper")
    grid = anchor_grid(base.anchors, (96, 320))
    mean = np.full((2, base.anchors.scale_count, len(base.anchors.ratios), 6), 20.0, np.float32)
    priors = AnchorPriors(mean, np.full_like(mean, 4.0))
    middle = len(grid.boxes) // 2
    box = np.array([[*grid.boxes[middle], *grid.center_xy[middle], 12.0, 1.6, 1.5, 3.9, 0.3]], np.float32)
    nothing = np.zeros((0, 4), np.float32)
    truth = GroundTruth(box, np.zeros(1, np.int64), nothing, nothing)
    everything = np.ones(len(grid.boxes), bool)
    targets = {}
    for name, chosen in (("with", base), ("without", ablated(base, ["no-anchor-prior"]))):
        by_prior = chosen.anchors.depth_by_prior
        targets[name] = assign(truth, grid, everything, priors=priors, depth_by_prior=by_prior).deltas
    depth = 6
    np.testing.assert_allclose(targets["with"][:, depth], (12.0 - 20.0) / 4.0, rtol=1e-6)
    np.testing.assert_allclose(targets["without"][:, depth], -np.log(12.0), rtol=1e-6)
    rest = [column for column in range(12) if column != depth]
    np.testing.assert_array_equal(targets["with"][:, rest], targets["without"][:, rest])
    assert not ablated(base, ["no-anchor-prior"]).manifest().anchors.depth_by_prior  # decoding asks the manifest


def test_disparity_is_supervised_by_what_the_name_says() -> None:
    sources = {name: ablated(preset("paper"), [name]).training.disparity_source for name in ABLATIONS}
    assert preset("paper").training.disparity_source == "block_matching"
    assert sources["no-disparity-supervision"] == "none" and sources["point-supervision"] == "points"


def test_without_the_filter_every_anchor_is_usable() -> None:
    chosen = ablated(preset("paper"), ["no-anchor-filter"])
    layout = preset("paper").anchors
    grid = anchor_grid(layout, (96, 320))
    mean = np.full((2, layout.scale_count, len(layout.ratios), 6), 20.0, np.float32)
    priors = AnchorPriors(mean, np.ones_like(mean))
    P2 = np.array([[250.0, 0, 160, 0], [0, 250.0, 24, 0], [0, 0, 1, 0]])
    filtered = usable_by_class(grid, layout, priors=priors, P2=P2)
    assert 0 < filtered.sum() < filtered.size
    everything = usable_by_class(grid, chosen.anchors, priors=priors, P2=P2)
    assert everything.shape == filtered.shape and everything.all()


def test_weights_are_taken_for_the_ablations_that_they_were_trained_with(tmp_path: Path) -> None:
    state = {"head.bias": torch.zeros(3)}
    plain, without = preset("compact"), ablated(preset("compact"), ["no-anchor-prior"])
    for chosen in (plain, without):
        save_weights(tmp_path / f"{chosen.name}.safetensors", state, metadata={"preset": chosen.name})
        check_ablations(tmp_path / f"{chosen.name}.safetensors", chosen)
    with pytest.raises(CheckpointError, match="give --ablate no-anchor-prior"):
        check_ablations(tmp_path / f"{without.name}.safetensors", plain)
    with pytest.raises(CheckpointError, match="give no --ablate"):
        check_ablations(tmp_path / f"{plain.name}.safetensors", without)
