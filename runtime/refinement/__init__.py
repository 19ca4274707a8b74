"""Depth from the camera's own pixels: samples of each box's visible surface, matched in both views."""

from runtime.refinement.confidence import (
    FEATURES,
    check_confidence,
    confidence_features,
    no_surer,
    probability,
    with_confidence,
)
from runtime.refinement.depth import refine_depths
from runtime.refinement.evidence import Refined
from runtime.refinement.kernel import RefineDepths, refiner
from runtime.refinement.occluders import OCCLUDER_SCORE

__all__ = [
    "FEATURES",
    "OCCLUDER_SCORE",
    "RefineDepths",
    "Refined",
    "check_confidence",
    "confidence_features",
    "no_surer",
    "probability",
    "refine_depths",
    "refiner",
    "with_confidence",
]
