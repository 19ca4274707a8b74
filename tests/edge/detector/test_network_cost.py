"""Parameters and multiply-adds of the paper's network, counted as the official code's were."""

from __future__ import annotations

import json
import math
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")
from torch import nn  # noqa: E402

from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.official import official_name  # noqa: E402
from edge.detector.presets import preset  # noqa: E402

pytestmark = pytest.mark.torch

RECORDED = json.loads((Path(__file__).resolve().parents[2] / "golden" / "network" / "macs_params.json").read_text())
PARTS = {
    "backbone": "backbone",
    "cost_volume_16": "neck.concat_volume",
    "four_to_eight": "neck.four_to_eight",
    "eight_to_sixteen": "neck.eight_to_sixteen",
    "depth_reason": "neck.sixteen",
    "depth_output(training only)": "disparity_branch",
    "cls_branch": "head.classification",
    "reg_branch": "head.regression",
}


@pytest.fixture(scope="module")
def detector() -> StereoDetector:
    """Shapes without memory."""
    with torch.device("meta"):
        return StereoDetector(preset("paper")).eval()


@pytest.mark.parametrize("part", PARTS)
def test_parameters_of_each_part(detector: StereoDetector, part: str) -> None:
    assert sum(p.numel() for p in detector.get_submodule(PARTS[part]).parameters()) == RECORDED["params"][part]


def test_multiply_adds_of_each_convolution(detector: StereoDetector, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())  # which tensors without memory do not have
    counted: dict[str, int] = {}

    def counts(name: str) -> Any:
        def hook(layer: Any, _inputs: Any, output: Any) -> None:
            counted[name] = output.numel() * math.prod(layer.weight.shape[1:])

        return hook

    for name, layer in detector.named_modules():
        if isinstance(layer, nn.Conv2d | nn.Conv3d):
            layer.register_forward_hook(counts(official_name(f"{name}.weight").removesuffix(".weight")))
    view = torch.zeros(1, 3, *preset("paper").input_size_hw, device="meta")
    detector.forward_training(view, view)
    assert counted == RECORDED["MACs_288x1280"]["per_layer"]
