"""Weights with smaller kernels as the start of a network with larger ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.build import build_detector  # noqa: E402
from edge.detector.checkpoint_file import read_checkpoint  # noqa: E402
from edge.detector.presets import Preset  # noqa: E402
from edge.detector.weights import load_weights, save_weights  # noqa: E402
from edge.training.widen import widened  # noqa: E402
from runtime.contracts.errors import CheckpointError  # noqa: E402

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]

LASTS = ("head.classification.6.weight", "head.regression.3.weight")


def with_last_kernels(chosen: Preset, size: int) -> Preset:
    head = replace(chosen.network.head, class_final_kernel=size, box_final_kernel=size)
    return replace(chosen, network=replace(chosen.network, head=head))


def saved(chosen: Preset, folder: Path) -> Path:
    torch.manual_seed(5)
    detector = build_detector(chosen)
    for last in (detector.head.classification[-1], detector.head.regression[-1]):
        torch.nn.init.normal_(last.weight, std=0.1)
    file = folder / "weights.safetensors"
    save_weights(file, detector.state_dict(), metadata={"preset": chosen.name})
    return file


@pytest.mark.parametrize(("small", "large"), [(1, 3), (1, 5), (3, 5)])
def test_larger_kernels_begin_as_the_same_function(toy: ModuleType, tmp_path: Path, small: int, large: int) -> None:
    narrow, wide = (with_last_kernels(toy.tiny_preset(), size) for size in (small, large))
    file = saved(narrow, tmp_path)
    before, after = build_detector(narrow).eval(), build_detector(wide).eval()
    load_weights(before, file)
    weights, grown = widened(read_checkpoint(file), after)
    assert grown == LASTS
    load_weights(after, weights)
    generator = torch.Generator().manual_seed(6)
    views = [torch.randn((1, 3, *narrow.input_size_hw), generator=generator) for _ in range(2)]
    with torch.no_grad():
        for expected, found in zip(before(*views), after(*views), strict=True):
            assert expected.abs().max() > 0
            torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_weights_that_fit_stay_as_they_are_and_others_are_refused(toy: ModuleType, tmp_path: Path) -> None:
    chosen = with_last_kernels(toy.tiny_preset(), 3)
    checkpoint = read_checkpoint(saved(chosen, tmp_path))
    same, grown = widened(checkpoint, build_detector(chosen))
    assert not grown
    assert all(same.state[name] is value for name, value in checkpoint.state.items())
    smaller = build_detector(with_last_kernels(chosen, 1))
    cut, grown = widened(checkpoint, smaller)
    assert not grown
    with pytest.raises(CheckpointError, match=r"classification\.6\.weight"):
        load_weights(smaller, cut)
