"""The network against intermediates recorded from the official code (reduced input size)."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.network import StereoDetector, inference_parameter_count  # noqa: E402
from edge.detector.official import from_official  # noqa: E402
from edge.detector.presets import preset  # noqa: E402

pytestmark = pytest.mark.torch

TRAINED_PARAMETERS, INFERENCE_PARAMETERS = 107_577_232, 100_081_936  # counted from the official code
ROUNDING_FACTOR = 10.0  # the recordings' own float32-to-float64 difference, times this
HALF_PRECISION = 1e-3  # relative, for tensors stored as float16


def load_module(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_paper_preset_has_the_published_parameter_count() -> None:
    detector = StereoDetector(preset("paper"))
    assert sum(p.numel() for p in detector.parameters()) == TRAINED_PARAMETERS
    assert inference_parameter_count(detector) == INFERENCE_PARAMETERS


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::ResourceWarning")  # the recordings' own script leaves a file to the collector
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_intermediates_equal_the_recording(reference_dir: Path) -> None:
    make_weights = load_module(reference_dir / "make_state_dict.py")
    make_inputs = load_module(reference_dir / "make_inputs.py")
    official = make_weights.make(str(reference_dir / "state_dict_names.json"), 0)
    detector = StereoDetector(preset("paper")).eval()
    state = from_official({name: torch.from_numpy(np.asarray(value)) for name, value in official.items()})
    detector.load_state_dict(state)

    left, right, _ = make_inputs.pair_u8(96, 320, 1000)
    seen: dict[str, torch.Tensor] = {}

    def keep(name: str):  # type: ignore[no-untyped-def]
        def hook(_module: object, _inputs: object, output: torch.Tensor) -> None:
            seen[name] = output.clone()

        return hook

    neck, head = detector.neck, detector.head
    for name, module in {
        "cv16_concat": neck.concat_volume,
        "p48_ghost": neck.four_to_eight.ghost,
        "p48_pool": neck.four_to_eight.pool,
        "p48_block": neck.four_to_eight.block,
        "p816_ghost": neck.eight_to_sixteen.ghost,
        "p816_block": neck.eight_to_sixteen.block,
        "p16_ghost": neck.sixteen.ghost,
        "cls_conv3_relu": head.classification[5],
        "reg_convbnrelu": head.regression[0],
        "reg_block": head.regression[1],
    }.items():
        module.register_forward_hook(keep(name))
    inputs = [torch.from_numpy(make_inputs.normalise(image)) for image in (left, right)]
    with torch.no_grad():
        seen["features"], stereo = detector.features(*inputs)
        seen["cls_out"], seen["reg_out"] = detector.head(seen["features"])
        seen["disp_logits"] = detector.disparity_branch(stereo)

    recorded = np.load(reference_dir / "net_96x320.npz")
    facts = json.loads((reference_dir / "net_96x320.json").read_text())["tensors"]
    for name, value in seen.items():
        expected = recorded[name].astype(np.float32)
        bound = ROUNDING_FACTOR * facts[name]["max_abs_diff_fp32_vs_fp64"]
        if recorded[name].dtype == np.float16:
            bound += HALF_PRECISION * float(np.abs(expected).max())
        assert value.shape == expected.shape, name
        assert np.abs(value.numpy() - expected).max() <= bound, name
