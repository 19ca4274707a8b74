"""Depth from the camera's own pixels: samples of each box's visible surface, matched in both views."""

from runtime.refinement.depth import refine_depths
from runtime.refinement.kernel import RefineDepths, refiner
from runtime.refinement.occluders import OCCLUDER_SCORE

__all__ = ["OCCLUDER_SCORE", "RefineDepths", "refine_depths", "refiner"]
