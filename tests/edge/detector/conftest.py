"""The recorded network cases of the official code: weights and images by rule, slices of what it computed."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

GOLDEN = Path(__file__).resolve().parents[2] / "golden" / "network"
ROUNDING_FACTOR = 10.0
"""The official network in float32 and in float64 differ by ``rounding``; ten times that is fair for any float32 one."""
HALF_PRECISION = 1e-3
"""Relative, for tensors recorded as float16."""


@dataclass(frozen=True, slots=True)
class RecordedCase:
    """One recorded forward pass: slices of its tensors, its detections, its calibration."""

    size_hw: tuple[int, int]
    arrays: dict[str, NDArray[Any]]
    tensors: dict[str, dict[str, Any]]
    P2: NDArray[np.float64]
    P3: NDArray[np.float64]

    def stored(self, name: str, value: NDArray[Any]) -> NDArray[Any]:
        """The part of a whole tensor that was recorded."""
        if not self.tensors[name]["slices"]:
            return value
        channels, rows, columns = self.tensors[name]["slices"]
        return value[:, ::channels, ::rows, ::columns]

    def kept(self, name: str, value: NDArray[Any]) -> NDArray[Any]:
        """The part of a whole tensor that lies here."""
        return self.stored(name, value).ravel()[:: self.tensors[name]["step"]]

    def check(self, name: str, found: NDArray[Any], expected: NDArray[Any]) -> None:
        """Compare with a recorded tensor within the rounding of float32."""
        assert found.shape == expected.shape, name
        wanted = expected.astype(np.float64)
        rounding = ROUNDING_FACTOR * self.tensors[name]["rounding"]
        bound = rounding + self.tensors[name]["half"] * HALF_PRECISION * np.abs(wanted)
        excess = float((np.abs(found - wanted) - bound).max())
        assert excess <= 0, f"{name}: {excess:.1e} beyond its bound of {rounding:.1e}"


@pytest.fixture(scope="session")
def recorded_case() -> Callable[[tuple[int, int]], RecordedCase]:
    """``recorded_case(size_hw)``."""
    return read_case


def read_case(size_hw: tuple[int, int]) -> RecordedCase:
    """The case of an input size."""
    name = f"net_{size_hw[0]}x{size_hw[1]}"
    facts = json.loads((GOLDEN / f"{name}.json").read_text())
    with np.load(GOLDEN / f"{name}.npz") as file:
        arrays = dict(file)
    return RecordedCase(size_hw, arrays, facts["tensors"], np.array(facts["P2"]), np.array(facts["P3"]))


@pytest.fixture(scope="session")
def by_rule(golden_module: Callable[[str], ModuleType]) -> ModuleType:
    """Makes weights and images."""
    return golden_module("network/recorded_case.py")


@pytest.fixture(scope="session")
def official_state(by_rule: ModuleType) -> Mapping[str, Any]:
    """Weights case 0 of the paper preset under the official names, torch tensors."""
    torch = pytest.importorskip("torch", reason="the torch workbench is not installed")
    from edge.detector.official import official_name
    from edge.detector.official_shapes import expected_shapes
    from edge.detector.presets import preset

    shapes = {official_name(name): shape for name, shape in expected_shapes(preset("paper")).items()}
    return {name: torch.from_numpy(np.asarray(value)) for name, value in by_rule.state_dict(shapes).items()}


@pytest.fixture(scope="session")
def official_detector(official_state: Mapping[str, Any]) -> Any:
    """The paper preset with these weights, in eval mode."""
    from edge.detector.network import StereoDetector
    from edge.detector.official import from_official
    from edge.detector.presets import preset

    detector = StereoDetector(preset("paper")).eval()
    detector.load_state_dict(from_official(official_state))
    return detector


@pytest.fixture(scope="session")
def recorded_inputs(by_rule: ModuleType) -> Any:
    """``recorded_inputs(size_hw)``: the two normalised images of a case, (1, 3, H, W) float32."""
    return lambda size_hw: [by_rule.normalised(image) for image in by_rule.image_pair(*size_hw, 1000)]
