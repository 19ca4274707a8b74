"""8-bit rounding while training: where, how exactly, that gradients pass, and that nothing of it stays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.ablations import ablated  # noqa: E402
from edge.detector.build import build_detector  # noqa: E402
from edge.detector.presets import NetworkShape, Preset, preset  # noqa: E402
from edge.training.checkpoint import load_checkpoint  # noqa: E402
from edge.training.fake_quantisation import FakeQuantisation, _Point, rounded_weight  # noqa: E402
from edge.training.loop import train  # noqa: E402
from edge.training.run_record import RunSettings  # noqa: E402
from edge.training.samples import SampleMaker  # noqa: E402
from edge.training.stream import MixedFrames  # noqa: E402
from quantize.qparams import activation_params, quantize_weight, weight_scales  # noqa: E402

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]

MODEL = Path(__file__).parents[3] / "edge/zoo/compact-int8/model.onnx"
OUTPUT_SCALE = 6
STEPS = 4
VISIBLE = 1e-5
"""Of an output's standard deviation, mostly biases': 256 levels move it by more, float32's rounding (1e-7) does not."""


def detector_of(chosen: Preset) -> torch.nn.Module:
    """Fresh weights, the last layers not zero, so that outputs depend on what comes before."""
    torch.manual_seed(3)
    detector = build_detector(chosen)
    for last in (detector.head.classification[-1], detector.head.regression[-1]):
        torch.nn.init.normal_(last.weight, std=0.1)
    return detector.eval()


def views(chosen: Preset, count: int = 1) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    return [torch.randn((count, 3, *chosen.input_size_hw), generator=generator) for _ in range(chosen.views)]


def test_a_tensor_of_zeros_or_without_a_range_stays_as_it_is() -> None:
    point = _Point(rectified=False)
    zeros = torch.zeros(1, 4, 2, 2)
    assert point.rounded(zeros) is zeros
    point.measure(zeros, 1.0)
    assert torch.equal(point.rounded(zeros), zeros)
    assert torch.equal(rounded_weight(zeros), zeros)


def test_values_that_are_not_finite_teach_no_range() -> None:
    point = _Point(rectified=False)
    point.measure(torch.full((1, 4, 2, 2), torch.nan), 1.0)
    assert point.bounds is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_activations_are_rounded_as_the_int8_graph_rounds_them(dtype: torch.dtype) -> None:
    x = torch.randn(2, 8, 16, 16, generator=torch.Generator().manual_seed(0)).to(dtype)
    point = _Point(rectified=False)
    point.bounds = torch.tensor([-1.5, 2.0], dtype=torch.float64)
    params = activation_params(-1.5, 2.0)
    expected = torch.from_numpy(params.dequantize(params.quantize(x.float().numpy()))).to(dtype)
    assert torch.equal(point.rounded(x), expected)
    assert point.rounded(x).dtype == dtype


@pytest.mark.parametrize("bits", [7, 8])
def test_weights_are_those_that_quantisation_stores(bits: int) -> None:
    weight = torch.randn(6, 5, 3, 3, generator=torch.Generator().manual_seed(1))
    weight[2] = 0
    scales = weight_scales(weight.numpy(), bits=bits, per_channel=True)
    expected = quantize_weight(weight.numpy(), scales, bits=bits) * scales.reshape(-1, 1, 1, 1)
    np.testing.assert_array_equal(rounded_weight(weight, bits=bits).numpy(), expected)
    folded = weight * torch.rand(6, 1, 1, 1).add(0.5)  # a norm folded in changes no level
    np.testing.assert_array_equal(
        quantize_weight(folded.numpy(), weight_scales(folded.numpy(), bits=bits, per_channel=True), bits=bits),
        quantize_weight(weight.numpy(), scales, bits=bits),
    )


def test_it_leaves_no_trace(toy: ModuleType) -> None:
    chosen = toy.tiny_preset()
    detector, images = detector_of(chosen), views(chosen)
    before = {name: value.clone() for name, value in detector.state_dict().items()}
    with torch.no_grad():
        plain = detector(*images)
        rounding = FakeQuantisation(detector)
        assert list(detector.state_dict()) == list(before)
        rounding.begin_step()
        rounded = detector(*images)
        rounding.remove()
        after = detector(*images)
    for one, other, last in zip(plain, rounded, after, strict=True):
        error = float((one - other).std() / one.std())
        assert VISIBLE < error < 1
        assert torch.equal(one, last)
    assert all(torch.equal(value, before[name]) for name, value in detector.state_dict().items())


@pytest.mark.parametrize("ablation", ["no-channel-expansion", "naive-channel-expansion", "no-scale-8", "no-scale-16"])
def test_every_place_of_an_ablated_network_is_passed(toy: ModuleType, ablation: str) -> None:
    chosen = ablated(toy.tiny_preset(), [ablation])
    detector = detector_of(chosen)
    rounding = FakeQuantisation(detector)
    rounding.begin_step()
    with torch.no_grad():
        detector(*views(chosen))
    assert set(rounding.state()["bounds"]) == set(rounding.places)


def test_places_are_as_many_as_the_int8_graph_has_scales() -> None:
    onnx = pytest.importorskip("onnx", reason="the workbench is not installed")
    if json.loads((MODEL.parent / "manifest.json").read_text())["provenance"]["given_back_to_float"] != "none":
        pytest.skip("the bundled model has layers in float, which training rounds all the same")
    graph = onnx.load(MODEL).graph
    scale_at = {"QuantizeLinear": 1, "QLinearStereoCorrelation": OUTPUT_SCALE}
    scales = {node.input[scale_at[node.op_type]] for node in graph.node if node.op_type in scale_at}
    rounding = FakeQuantisation(build_detector(preset("compact")))
    assert len(rounding.places) == len(scales - {"one_step"})


def test_gradients_pass_to_all_that_learns(toy: ModuleType) -> None:
    chosen = toy.tiny_preset()
    detector, images = detector_of(chosen), views(chosen)
    rounding = FakeQuantisation(detector)
    rounding.begin_step()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = detector.forward_training(*images)
    sum(output.float().square().mean() for output in outputs).backward()
    for name, parameter in detector.named_parameters():
        assert parameter.grad is not None and parameter.grad.dtype == torch.float32, name
        assert torch.isfinite(parameter.grad).all(), name
    for name in ("backbone.layer1.0.conv1", "neck.four_to_eight.ghost.primary.0", "head.regression.3"):
        assert detector.get_submodule(name).weight.grad.abs().sum() > 0, name


def test_the_monocular_head_with_its_deformable_convolution() -> None:
    mono = preset("mono")
    head = replace(mono.network.head, class_width=16, box_width=16)
    network = NetworkShape(backbone_depth=50, backbone_widths=(8, 8, 8), neck=None, head=head)
    chosen = replace(mono, input_size_hw=(64, 96), network=network)
    detector, images = detector_of(chosen), views(chosen)
    with torch.no_grad():
        plain = detector(*images)
        rounding = FakeQuantisation(detector)
        rounding.begin_step()
        for one, other in zip(plain, detector(*images), strict=True):
            assert VISIBLE < float((one - other).std() / one.std()) < 1
    assert {"head.regression.0.conv_offset", "head.regression.1"} <= set(rounding.state()["bounds"])


def settings(steps: int, *, quantize_aware: bool) -> RunSettings:
    return RunSettings(
        steps, 2, 1e-3, 1e-4, warmup_steps=0, workers=0, mixed_precision=False, quantize_aware=quantize_aware
    )


def run(toy: ModuleType, run_dir: Path, made: RunSettings, *, resume: bool = False) -> dict[str, torch.Tensor]:
    run_dir.mkdir(exist_ok=True)
    torch.manual_seed(5)
    chosen = toy.tiny_preset()
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    frames = MixedFrames([toy.DrawnFrames()], [1], maker=maker, seed=2)
    detector = build_detector(chosen)
    return train(detector, chosen, frames, settings=made, run_dir=run_dir, resume=resume).state


def test_a_run_that_was_interrupted_ends_at_the_same_bits(toy: ModuleType, tmp_path: Path) -> None:
    through = run(toy, tmp_path / "through", settings(STEPS, quantize_aware=True))
    run(toy, tmp_path / "cut", settings(STEPS // 2, quantize_aware=True))
    resumed = run(toy, tmp_path / "cut", settings(STEPS, quantize_aware=True), resume=True)
    assert all(torch.equal(value, resumed[name]) for name, value in through.items())
    plain = run(toy, tmp_path / "plain", settings(STEPS, quantize_aware=False))
    assert list(plain) == list(through)
    assert any(not torch.equal(value, plain[name]) for name, value in through.items())


def test_weights_of_seven_bits_are_learned_under_coarser_levels(toy: ModuleType, tmp_path: Path) -> None:
    made = settings(1, quantize_aware=True)
    eight, seven = (run(toy, tmp_path / str(bits), replace(made, weight_bits=bits)) for bits in (8, 7))
    assert any(not torch.equal(value, seven[name]) for name, value in eight.items())


def test_a_plain_run_is_finished_under_rounding(toy: ModuleType, tmp_path: Path) -> None:
    run(toy, tmp_path / "run", settings(STEPS // 2, quantize_aware=False))
    assert "rounding" not in load_checkpoint(tmp_path / "run/checkpoint.pt")
    run(toy, tmp_path / "run", settings(STEPS, quantize_aware=True), resume=True)
    kept = load_checkpoint(tmp_path / "run/checkpoint.pt")["rounding"]
    assert kept["steps"] == STEPS - STEPS // 2
    assert all(bool((bounds[0] <= bounds[1]).all()) for bounds in kept["bounds"].values())
