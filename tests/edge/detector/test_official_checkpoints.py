"""Official checkpoints: every way of saving them, widths and depths by their shapes, refusals that name the misfit."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.checkpoint_file import Checkpoint, read_checkpoint  # noqa: E402
from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.official import is_weight, official_name, our_name  # noqa: E402
from edge.detector.official_shapes import class_count, expected_shapes, fitted_preset  # noqa: E402
from edge.detector.presets import HeadShape, NeckShape, NetworkShape, Preset, preset  # noqa: E402
from edge.detector.weights import load_weights  # noqa: E402
from runtime.contracts.errors import CheckpointError  # noqa: E402

pytestmark = pytest.mark.torch

PAPER = preset("paper")
SMALL = NetworkShape(
    backbone_depth=18,
    backbone_widths=(8, 12, 20),
    neck=NeckShape(
        disparities_at_4=6,
        disparities_at_8=5,
        concat_features=4,
        concat_shifts=3,
        width_at_8=10,
        width_at_16=14,
        out_channels=18,
        disparity_widths=(9, 7),
        disparity_classes=16,
    ),
    head=HeadShape(class_width=11, box_width=13),
)
EXTRA_BUFFERS = {
    "bbox_head.balance_weights": (2,),
    "bbox_head.regression_weight": (13,),
    "bbox_head.loss_cls.balance_weights": (2,),
    "bbox_head.anchors.anchors": (1, 64, 4),
    "core.backbone.bn1.num_batches_tracked": (),
}
LAST_CLASS_LAYER = "bbox_head.cls_feature_extraction.6"


def small_preset(**changes: Any) -> Preset:
    return dataclasses.replace(PAPER, network=dataclasses.replace(SMALL, **changes))


def official_state(chosen: Preset, seed: int = 0) -> dict[str, torch.Tensor]:
    torch.manual_seed(seed)
    state = {official_name(name): value for name, value in StereoDetector(chosen).state_dict().items()}
    return state | {name: torch.zeros(shape) for name, shape in EXTRA_BUFFERS.items()}


def shapes_alone(chosen: Preset, changes: dict[str, tuple[int, ...] | None] | None = None) -> Checkpoint:
    """A checkpoint without memory behind it; ``changes`` by official name: another shape, or None to leave out."""
    shapes: dict[str, tuple[int, ...] | None] = {official_name(n): s for n, s in expected_shapes(chosen).items()}
    shapes.update(changes or {})
    state = {our_name(name): torch.zeros(()).expand(shape) for name, shape in shapes.items() if shape is not None}
    return Checkpoint(Path("Stereo3D_latest.pth"), state, official=True)


def test_names_go_both_ways() -> None:
    for name in expected_shapes(PAPER):
        assert is_weight(official_name(name)) and our_name(official_name(name)) == name
        assert official_name(name).startswith(("core.", "bbox_head."))
    assert not any(is_weight(name) for name in EXTRA_BUFFERS if not name.endswith("num_batches_tracked"))


def plain(state: dict[str, torch.Tensor]) -> Any:
    return state


def parallel(state: dict[str, torch.Tensor]) -> Any:
    return {f"module.{name}": value for name, value in state.items()}


def in_a_record(state: dict[str, torch.Tensor]) -> Any:
    return {
        "epoch": 79,
        "model_state_dict": parallel(state),
        "optimizer": {"state": {}, "param_groups": [{"lr": 1e-4}]},
    }


def in_lightning(state: dict[str, torch.Tensor]) -> Any:
    return {"state_dict": state, "global_step": 7}


@pytest.mark.parametrize("saved_as", [plain, parallel, in_a_record, in_lightning])
def test_every_way_of_saving_loads_the_same(tmp_path: Path, saved_as: Callable[..., Any]) -> None:
    chosen = small_preset()
    state = official_state(chosen)
    torch.save(saved_as(state), tmp_path / "Stereo3D_latest.pth")
    checkpoint = read_checkpoint(tmp_path / "Stereo3D_latest.pth")
    fitted = fitted_preset(PAPER, checkpoint)
    assert fitted == chosen
    detector = StereoDetector(fitted)
    load_weights(detector, checkpoint)
    for name, value in detector.state_dict().items():
        torch.testing.assert_close(value, state[official_name(name)].to(value.dtype), rtol=0, atol=0)


@pytest.mark.parametrize("depth", [18, 34, 50, 101])
@pytest.mark.parametrize("widths", [(64, 128, 256), (8, 12, 20)])
def test_depth_and_widths_are_read_from_the_shapes(depth: int, widths: tuple[int, int, int]) -> None:
    chosen = small_preset(backbone_depth=depth, backbone_widths=widths)
    assert fitted_preset(PAPER, shapes_alone(chosen)) == chosen


def test_the_preset_itself_stays_as_it_is() -> None:
    assert fitted_preset(PAPER, shapes_alone(PAPER)) is PAPER


def test_without_the_disparity_branch() -> None:
    chosen = small_preset()
    branch = [official_name(name) for name in expected_shapes(chosen) if name.startswith("disparity_branch.")]
    fitted = fitted_preset(PAPER, shapes_alone(chosen, dict.fromkeys(branch)))
    inference = dataclasses.replace(SMALL.neck, disparity_widths=(576, 288), disparity_classes=96)
    assert fitted.network == dataclasses.replace(SMALL, neck=inference)


@pytest.mark.parametrize("classes", [("Car",), ("Car", "Pedestrian", "Cyclist")])
def test_other_class_counts_need_their_names(classes: tuple[str, ...]) -> None:
    checkpoint = shapes_alone(dataclasses.replace(PAPER, classes=classes))
    assert class_count(PAPER, checkpoint) == len(classes)
    assert fitted_preset(PAPER, checkpoint, classes).classes == classes
    with pytest.raises(CheckpointError, match=rf"{len(classes)} classes.*--classes"):
        fitted_preset(PAPER, checkpoint)


@pytest.mark.parametrize("classes", [("Car", ""), ("Car", "Car")])
def test_class_names_that_name_nothing(classes: tuple[str, ...]) -> None:
    with pytest.raises(CheckpointError, match="each name once"):
        fitted_preset(PAPER, shapes_alone(PAPER), classes)


def test_other_anchors_are_refused() -> None:
    two_ratios = dataclasses.replace(PAPER, anchors=dataclasses.replace(PAPER.anchors, ratios=(0.5, 1.0)))
    with pytest.raises(CheckpointError, match=r"384 channels in bbox_head\.reg_feature_extraction\.3.*48 anchors"):
        fitted_preset(PAPER, shapes_alone(two_ratios))


@pytest.mark.parametrize("base", [PAPER, small_preset()])
@pytest.mark.parametrize(
    ("name", "shape", "said"),
    [
        ("core.backbone.layer2.0.conv1.weight", None, "lacks core.backbone.layer2.0.conv1.weight"),
        ("core.neck.cost_volume_2.conv3d.1.running_var", None, "lacks core.neck.cost_volume_2.conv3d.1.running_var"),
        ("core.backbone.layer1.0.conv1.weight", (5, 3, 3, 3), "layer1.0.conv1.weight 5x3x3x3 instead of"),
        (f"{LAST_CLASS_LAYER}.weight", (10, 11, 3, 3), f"{LAST_CLASS_LAYER}.weight 10x11x3x3 instead of 144x"),
        ("core.transformer.weight", (4, 4), "unknown core.transformer.weight 4x4"),
        ("core.backbone.layer4.0.conv1.weight", (512, 256, 3, 3), "unknown core.backbone.layer4.0.conv1.weight"),
    ],
)
def test_what_does_not_fit_is_named(base: Preset, name: str, shape: tuple[int, ...] | None, said: str) -> None:
    with pytest.raises(CheckpointError) as refused:
        fitted_preset(PAPER, shapes_alone(base, {name: shape}))
    message = str(refused.value)
    assert said in message and "\n" not in message
    assert "more" not in message  # nothing but the odd one is blamed


def test_a_backbone_of_no_known_depth() -> None:
    chosen = small_preset(backbone_depth=50)
    gone = [official_name(name) for name in expected_shapes(chosen) if name.startswith("backbone.layer3.5.")]
    with pytest.raises(CheckpointError, match=r"3, 4, 5 bottlenecks .* depth 18, 34, 50, 101"):
        fitted_preset(PAPER, shapes_alone(chosen, dict.fromkeys(gone)))


def test_a_file_of_something_else(tmp_path: Path) -> None:
    file = tmp_path / "resnet.pth"
    torch.save({"fc.weight": torch.zeros(10, 4)}, file)
    with pytest.raises(CheckpointError, match=r"lacks .* and \d+ more; has the unknown fc\.weight 10x4"):
        load_weights(StereoDetector(small_preset()), file)
    torch.save(torch.nn.Linear(2, 2), file)
    with pytest.raises(CheckpointError, match=r"save model\.state_dict"):
        read_checkpoint(file)
    torch.save([1, 2], file)
    with pytest.raises(CheckpointError, match="no tensors by name"):
        read_checkpoint(file)


def test_values_that_are_not_finite(tmp_path: Path) -> None:
    chosen = small_preset()
    state = official_state(chosen)
    state[f"{LAST_CLASS_LAYER}.bias"][3] = float("nan")
    torch.save(state, tmp_path / "diverged.pth")
    with pytest.raises(CheckpointError, match=rf"{LAST_CLASS_LAYER}\.bias .* not finite"):
        load_weights(StereoDetector(chosen), tmp_path / "diverged.pth")
