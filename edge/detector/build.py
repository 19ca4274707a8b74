"""A preset's network, stereo or mono."""

from __future__ import annotations

from edge.detector.mono_network import MonoDetector
from edge.detector.network import StereoDetector
from edge.detector.presets import Preset

Detector = StereoDetector | MonoDetector


def build_detector(preset: Preset) -> Detector:
    """The preset's network with fresh weights."""
    return StereoDetector(preset) if preset.views == 2 else MonoDetector(preset)
