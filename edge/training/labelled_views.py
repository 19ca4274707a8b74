"""Labelled frames as a preset's network image sees them."""

from __future__ import annotations

from collections.abc import Iterator

from edge.detector.presets import Preset
from edge.training.ground_truth import with_every_alpha
from runtime.contracts.geometry import FloatArray
from runtime.contracts.objects import Objects3D
from runtime.preprocess import network_view
from runtime.sources.base import FrameSequence


def labelled_views(source: FrameSequence, preset: Preset) -> Iterator[tuple[Objects3D, FloatArray]]:
    """Objects of each labelled frame and their 2D boxes (N, 4) in network pixels."""
    manifest = preset.manifest()
    for index in range(len(source)):
        objects = source.labels(index)
        if objects is None:
            continue
        view = network_view(source[index].geometry, manifest)
        yield with_every_alpha(objects, view.geometry.P2), view.to_network(objects.box_in_left_image)
