"""Other clothes and other arms for the people of a layout: what is drawn changes, what the label says does not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.simulation.bodies.library import spare_body
from edge.simulation.placing import PlacedObject

SPARE_COUNTS = {"Pedestrian": 96, "Cyclist": 48}
_CHANGED_SHARE = 0.75
_STRETCH_LIMITS = (0.82, 1.22)
_TRIES = 6


def dress(objects: tuple[PlacedObject, ...], rng: np.random.Generator) -> tuple[PlacedObject, ...]:
    """The objects, most pedestrians and cyclists with another body that fills the same box.

    Args:
        objects: as laid out.
        rng: source of chance.
    """
    return tuple(_dressed(item, rng) if item.kind in SPARE_COUNTS else item for item in objects)


def _dressed(item: PlacedObject, rng: np.random.Generator) -> PlacedObject:
    if rng.random() > _CHANGED_SHARE:
        return item
    for _ in range(_TRIES):
        other = spare_body(item.kind, int(rng.integers(SPARE_COUNTS[item.kind])))
        height, width, length = (float(value) for value in other.size_hwl[0])
        stretch = np.array(item.size_hwl) / (height, width, length)
        if (stretch >= _STRETCH_LIMITS[0]).all() and (stretch <= _STRETCH_LIMITS[1]).all():
            return replace(item, body=other, phase=0, mesh_hwl=(height, width, length))
    return item
