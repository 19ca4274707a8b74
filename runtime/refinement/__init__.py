"""Depth from the camera's own pixels: samples of each box's visible surface, matched in both views."""

from runtime.refinement.depth import refine_depths

__all__ = ["refine_depths"]
