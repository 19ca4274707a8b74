"""Street furniture: lamps, signs, traffic lights, bollards, fences, walls, rails, bins, shelters, parked bicycles."""

from __future__ import annotations

from functools import cache

import numpy as np

from edge.simulation.bodies.cyclist import bicycle_parts
from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import Rgb, box, disc, join, quads_mesh, tube

_STEEL: Rgb = (0.26, 0.27, 0.28)
_DARK: Rgb = (0.05, 0.055, 0.06)
SIGN_COUNT = 7
FENCE_LENGTH_M = 5.0


@cache
def lamp_post(index: int) -> Mesh:
    """A street lamp whose arm reaches along -x."""
    height = (7.5, 5.0, 9.0)[index % 3]
    if index % 3 == 1:
        return join(
            [
                tube([(0, 0.1, 0), (0, -height, 0)], [0.06, 0.045], material=Material.METAL, colour=_DARK, sides=7),
                box(
                    (-0.25, -height, -0.25),
                    (0.25, -height - 0.35, 0.25),
                    material=Material.LAMP,
                    colour=(0.5, 0.5, 0.48),
                ),
            ]
        )
    pole = tube(
        [(0, 0.1, 0), (0, -height + 0.6, 0), (-0.4, -height, 0), (-1.7, -height - 0.15, 0)],
        [0.09, 0.06, 0.05, 0.045],
        material=Material.METAL,
        colour=_STEEL,
        sides=7,
    )
    return join(
        [
            pole,
            box(
                (-2.3, -height - 0.22, -0.14),
                (-1.6, -height - 0.08, 0.14),
                material=Material.METAL,
                colour=(0.4, 0.4, 0.4),
            ),
        ]
    )


@cache
def sign(index: int) -> Mesh:
    """A traffic sign facing -z."""
    top = -2.5
    post = tube([(0, 0.1, 0), (0, top - 0.4, 0)], 0.033, material=Material.METAL, colour=_STEEL, sides=6)
    red, white, blue, yellow = (0.5, 0.02, 0.02), (0.75, 0.75, 0.75), (0.02, 0.1, 0.42), (0.6, 0.42, 0.02)
    face = -0.05

    def plate(low: tuple[float, float], high: tuple[float, float], colour: Rgb, z: float = face) -> Mesh:
        return box((low[0], low[1], z), (high[0], high[1], z + 0.02), material=Material.SIGN, colour=colour)

    kind = index % SIGN_COUNT
    if kind == 0:
        parts = [
            disc((0, top, face), axis=2, radius=0.3, sign=-1, material=Material.SIGN, colour=red),
            disc((0, top, face - 0.005), axis=2, radius=0.23, sign=-1, material=Material.SIGN, colour=white),
        ]
    elif kind == 1:
        parts = [disc((0, top, face), axis=2, radius=0.3, sign=-1, material=Material.SIGN, colour=blue)]
    elif kind == 2:
        corners = np.array(
            [
                [(-0.42, top + 0.3, face), (0.42, top + 0.3, face), (0.0, top - 0.42, face), (0.0, top - 0.42, face)],
                [
                    (-0.27, top + 0.2, face - 0.006),
                    (0.27, top + 0.2, face - 0.006),
                    (0.0, top - 0.24, face - 0.006),
                    (0.0, top - 0.24, face - 0.006),
                ],
            ]
        )
        parts = [
            quads_mesh(corners, np.array([[0, 0, -1.0]] * 2), material=Material.SIGN, colour=np.array([red, white]))
        ]
    elif kind == 3:
        parts = [
            plate((-0.3, top - 0.3), (0.3, top + 0.3), blue),
            plate((-0.14, top - 0.2), (0.14, top + 0.2), white, face - 0.008),
        ]
    elif kind == 4:
        parts = [
            plate((-0.9, top - 0.8), (0.9, top + 0.3), yellow),
            plate((-0.7, top - 0.6), (0.5, top - 0.45), _DARK, face - 0.008),
            plate((-0.7, top - 0.2), (0.3, top - 0.05), _DARK, face - 0.008),
        ]
    elif kind == 5:
        parts = [
            plate((-0.25, top - 0.35), (0.25, top + 0.35), white),
            plate((-0.15, top - 0.1), (0.15, top + 0.05), _DARK, face - 0.008),
        ]
    else:
        parts = [
            disc((0, top, face), axis=2, radius=0.33, sign=-1, material=Material.SIGN, colour=yellow, sides=4),
            plate((-0.3, top + 0.45), (0.3, top + 0.65), white),
        ]
    return join([post, *parts])


@cache
def traffic_light() -> Mesh:
    """A signal on a post, facing -z."""
    parts = [
        tube([(0, 0.1, 0), (0, -3.3, 0)], 0.06, material=Material.METAL, colour=_STEEL, sides=7),
        box((-0.17, -2.3, -0.3), (0.17, -3.3, -0.05), material=Material.MATTE, colour=(0.02, 0.02, 0.02)),
    ]
    for y, colour in ((-3.1, (0.6, 0.02, 0.02)), (-2.8, (0.06, 0.05, 0.01)), (-2.5, (0.01, 0.06, 0.03))):
        parts.append(disc((0, y, -0.31), axis=2, radius=0.1, sign=-1, material=Material.LAMP, colour=colour))
    return join(parts)


@cache
def bollard(index: int) -> Mesh:
    """A short post."""
    if index % 2:
        return tube([(0, 0.1, 0), (0, -0.9, 0)], 0.06, material=Material.METAL, colour=_DARK, sides=7)
    return join(
        [
            tube([(0, 0.1, 0), (0, -0.75, 0)], 0.09, material=Material.CONCRETE, colour=(0.6, 0.1, 0.08), sides=7),
            tube([(0, -0.75, 0), (0, -1.0, 0)], 0.09, material=Material.CONCRETE, colour=(0.7, 0.7, 0.7), sides=7),
        ]
    )


@cache
def fence(index: int) -> Mesh:
    """Five metres of fence, wall or railing along x."""
    half = 0.5 * FENCE_LENGTH_M
    if index % 4 == 0:
        return box((-half, 0.05, -0.12), (half, -1.0, 0.12), material=Material.CONCRETE, colour=(0.34, 0.32, 0.28))
    if index % 4 == 1:
        parts = [
            box((x, 0.05, -0.02), (x + 0.1, -1.1, 0.02), material=Material.BARK, colour=(0.22, 0.15, 0.09))
            for x in np.arange(-half, half, 0.16)
        ]
        parts.append(box((-half, -0.8, 0.02), (half, -0.88, 0.05), material=Material.BARK, colour=(0.2, 0.14, 0.09)))
        return join(parts)
    if index % 4 == 2:
        parts = [
            box((x, 0.05, -0.015), (x + 0.03, -1.2, 0.015), material=Material.METAL, colour=_DARK)
            for x in np.arange(-half, half, 0.14)
        ]
        parts += [
            box((-half, y, -0.02), (half, y - 0.04, 0.02), material=Material.METAL, colour=_DARK) for y in (-0.1, -1.1)
        ]
        return join(parts)
    parts = [box((x, 0.05, -0.05), (x + 0.1, -0.7, 0.05), material=Material.METAL, colour=_STEEL) for x in (-half, 0.0)]
    parts.append(box((-half, -0.45, -0.09), (half, -0.75, -0.05), material=Material.METAL, colour=(0.35, 0.36, 0.37)))
    return join(parts)


@cache
def bin_or_box(index: int) -> Mesh:
    """A wheeled bin, a cable cabinet, or a bench."""
    if index % 3 == 0:
        colour: Rgb = ((0.03, 0.03, 0.035), (0.03, 0.1, 0.04), (0.35, 0.25, 0.02))[index % 9 // 3]
        return join(
            [
                box((-0.28, 0.0, -0.35), (0.28, -1.0, 0.35), material=Material.MATTE, colour=colour),
                box((-0.31, -1.0, -0.4), (0.31, -1.1, 0.38), material=Material.MATTE, colour=colour),
            ]
        )
    if index % 3 == 1:
        return box((-0.6, 0.0, -0.18), (0.6, -1.2, 0.18), material=Material.METAL, colour=(0.3, 0.31, 0.28))
    seat = box((-0.9, -0.42, -0.2), (0.9, -0.48, 0.2), material=Material.BARK, colour=(0.25, 0.17, 0.1))
    back = box((-0.9, -0.55, 0.2), (0.9, -0.9, 0.24), material=Material.BARK, colour=(0.25, 0.17, 0.1))
    legs = [box((x, 0.0, -0.18), (x + 0.06, -0.9, 0.22), material=Material.METAL, colour=_DARK) for x in (-0.8, 0.74)]
    return join([seat, back, *legs])


@cache
def shelter() -> Mesh:
    """A bus stop shelter open towards -z."""
    parts = [
        box((-2.0, -2.3, -0.9), (2.0, -2.42, 0.7), material=Material.METAL, colour=_DARK),
        box((-2.0, -0.3, 0.55), (2.0, -2.2, 0.58), material=Material.GLASS, colour=(0.05, 0.06, 0.06)),
    ]
    parts += [
        tube([(x, 0.05, 0.55), (x, -2.35, 0.55)], 0.05, material=Material.METAL, colour=_DARK, sides=6)
        for x in (-1.95, 0.0, 1.95)
    ]
    parts.append(box((0.9, -0.5, -0.8), (1.0, -2.2, 0.5), material=Material.SIGN, colour=(0.5, 0.45, 0.4)))
    return join(parts)


@cache
def parked_bicycle(index: int) -> Mesh:
    """A bicycle without a rider."""
    rng = np.random.default_rng([16_180, index])
    colour = tuple(float(value) for value in rng.uniform(0.02, 0.4, 3))
    return join(bicycle_parts(colour, basket=bool(index % 2)))  # type: ignore[arg-type]


@cache
def mast() -> Mesh:
    """A tall mast with a cross-arm (overhead line)."""
    return join(
        [
            tube(
                [(0, 0.1, 0), (0, -8.0, 0)], [0.14, 0.1], material=Material.CONCRETE, colour=(0.3, 0.3, 0.29), sides=8
            ),
            box((-2.4, -7.2, -0.05), (0.1, -7.35, 0.05), material=Material.METAL, colour=_STEEL),
        ]
    )
