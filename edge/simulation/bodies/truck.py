"""Lorries: cab, chassis, wheels and a load (box, tarpaulin, tipper, tank) or a bus body."""

from __future__ import annotations

import numpy as np

from edge.simulation.bodies.car import wheel
from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import box, fitted, join, tube

_DARK = (0.03, 0.03, 0.032)
_GLASS = (0.03, 0.035, 0.04)
_WHITE = (1.0, 1.0, 1.0)
LOADS = ("box", "tarpaulin", "tipper", "tank")


def build_truck(size_hwl: tuple[float, float, float], *, load: str, rng: np.random.Generator) -> Mesh:
    """A lorry facing +x whose extent is exactly ``size_hwl``."""
    height, width, length = size_hwl
    half = 0.5 * width
    nose = 0.5 * length
    cab_length = min(2.1, 0.3 * length)
    cab_top = -min(height, 2.5 + 0.5 * rng.random())
    cab_back = nose - cab_length
    deck = -1.05
    parts = [
        box((cab_back, -0.45, -half), (nose, cab_top, half), material=Material.CAR_PAINT, colour=_WHITE),
        box(
            (nose - 0.3, cab_top + 0.35, -0.92 * half),
            (nose + 0.012, -1.45, 0.92 * half),
            material=Material.GLASS,
            colour=_GLASS,
        ),
        box(
            (cab_back + 0.55, cab_top + 0.4, -half - 0.012),
            (nose - 0.25, -1.55, half + 0.012),
            material=Material.GLASS,
            colour=_GLASS,
        ),
        box((nose - 0.2, -0.35, -0.98 * half), (nose + 0.03, -0.7, 0.98 * half), material=Material.MATTE, colour=_DARK),
        box((nose - 0.2, -0.95, -0.6 * half), (nose + 0.015, -1.3, 0.6 * half), material=Material.MATTE, colour=_DARK),
        box((-nose, -0.55, -0.75 * half), (cab_back, deck, 0.75 * half), material=Material.MATTE, colour=_DARK),
        box(
            (-nose - 0.01, -0.6, -0.95 * half), (-nose + 0.1, -0.9, 0.95 * half), material=Material.MATTE, colour=_DARK
        ),
    ]
    for side in (-1.0, 1.0):
        low, high = sorted((side * 0.6 * half, side * 0.95 * half))
        parts.append(
            box((nose - 0.1, -0.72, low), (nose + 0.035, -0.92, high), material=Material.LAMP, colour=(0.75, 0.78, 0.8))
        )
        parts.append(
            box(
                (-nose - 0.02, -0.7, low),
                (-nose + 0.1, -0.86, high),
                material=Material.LAMP,
                colour=(0.36, 0.012, 0.012),
            )
        )
    parts += _load(size_hwl, load=load, front=cab_back - 0.15, deck=deck, rng=rng)
    axles = [nose - 0.75 - 0.25 * cab_length, -nose + 0.18 * length]
    if length > 8.5:
        axles.append(-nose + 0.18 * length + 1.3)
    for x in axles:
        for side in (-1.0, 1.0):
            parts += wheel(x, radius=0.48, outer_z_m=side * 0.985 * half, thickness_m=0.32 * side)
    return fitted(join(parts), size_hwl)


def _load(
    size_hwl: tuple[float, float, float], *, load: str, front: float, deck: float, rng: np.random.Generator
) -> list[Mesh]:
    height, width, length = size_hwl
    half, tail = 0.5 * width, -0.5 * length
    if load in ("box", "tarpaulin"):
        paint = load == "box"
        colour = (
            _WHITE
            if paint
            else tuple(rng.choice([[0.05, 0.12, 0.3], [0.5, 0.5, 0.48], [0.03, 0.16, 0.07], [0.4, 0.05, 0.03]]))
        )
        material = Material.CAR_PAINT if paint and rng.random() < 0.5 else Material.MATTE
        colour = colour if material == Material.CAR_PAINT or not paint else (0.6, 0.6, 0.58)
        body = [box((tail, deck, -half), (front, -height, half), material=material, colour=colour)]
        for x in np.linspace(tail + 0.02, front - 0.02, 5 if load == "tarpaulin" else 2):
            body.append(
                box(
                    (x - 0.03, deck, -half - 0.01),
                    (x + 0.03, -height, half + 0.01),
                    material=Material.METAL,
                    colour=(0.2, 0.2, 0.2),
                )
            )
        return body
    if load == "tank":
        radius = 0.5 * (height + deck)
        middle = deck - radius
        return [
            tube(
                [(tail, middle, 0.0), (front, middle, 0.0)],
                radius,
                material=Material.METAL,
                colour=(0.5, 0.5, 0.52),
                sides=14,
            )
        ]
    wall = deck - max(0.55, 0.5 * (height + deck))
    colour = (0.25, 0.2, 0.12) if rng.random() < 0.5 else (0.12, 0.14, 0.17)
    return [
        box((tail, deck, -half), (front, deck - 0.1, half), material=Material.METAL, colour=colour),
        box((tail, deck, -half), (front, wall, -half + 0.06), material=Material.METAL, colour=colour),
        box((tail, deck, half - 0.06), (front, wall, half), material=Material.METAL, colour=colour),
        box((tail, deck, -half), (tail + 0.06, wall, half), material=Material.METAL, colour=colour),
        box((front - 0.06, deck, -half), (front, -height, half), material=Material.METAL, colour=colour),
        box(
            (tail + 0.4, wall, -0.7 * half),
            (front - 0.4, wall - 0.3, 0.7 * half),
            material=Material.BARK,
            colour=(0.16, 0.11, 0.07),
        ),
    ]
