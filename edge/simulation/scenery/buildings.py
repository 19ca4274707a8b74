"""A fixed library of buildings: blocks of flats, houses with gables, halls, garages. Front faces +z, base at y = 0."""

from __future__ import annotations

from functools import cache

import numpy as np

from edge.simulation.scene import Material, Mesh
from edge.simulation.scenery.house_fronts import front_details
from edge.simulation.solids import Rgb, box, join, quads_mesh

_LIBRARY_SEED = 31_415
BLOCK_COUNT, HOUSE_COUNT, HALL_COUNT = 16, 14, 8
_WALLS: tuple[Rgb, ...] = (
    (0.48, 0.42, 0.32), (0.55, 0.52, 0.46), (0.42, 0.36, 0.28), (0.30, 0.15, 0.11), (0.50, 0.33, 0.22),
    (0.36, 0.37, 0.38),    (0.62, 0.60, 0.55), (0.45, 0.44, 0.33), (0.24, 0.20, 0.17), (0.52, 0.42, 0.26),
)  # fmt: skip
_ROOFS: tuple[Rgb, ...] = ((0.22, 0.09, 0.06), (0.15, 0.07, 0.05), (0.09, 0.09, 0.095), (0.17, 0.12, 0.09))


def _gable_roof(
    width: float, depth: float, wall_height: float, *, rise: float, colour: Rgb, wall: Rgb, overhang: float = 0.4
) -> Mesh:
    """A ridge along x over a block width x depth."""
    x, z = 0.5 * width + overhang, 0.5 * depth + overhang
    eaves, ridge = -wall_height + 0.1, -wall_height - rise
    slopes = np.array(
        [
            [[-x, eaves, z], [x, eaves, z], [x, ridge, 0], [-x, ridge, 0]],
            [[x, eaves, -z], [-x, eaves, -z], [-x, ridge, 0], [x, ridge, 0]],
        ]
    )
    tilt = np.array([0.0, -z, rise + 0.1])
    tilt = tilt / np.linalg.norm(tilt)
    roof = quads_mesh(slopes, np.array([tilt, tilt * [1, 1, -1]]), material=Material.FACADE, colour=colour)
    half_w, half_d = 0.5 * width, 0.5 * depth
    gables = np.array(
        [
            [
                [side * half_w, -wall_height, -half_d],
                [side * half_w, -wall_height, half_d],
                [side * half_w, ridge + 0.1, 0],
                [side * half_w, ridge + 0.1, 0],
            ]
            for side in (-1.0, 1.0)
        ]
    )
    ends = quads_mesh(gables, np.array([[-1.0, 0, 0], [1.0, 0, 0]]), material=Material.CONCRETE, colour=wall)
    return join([roof, ends])


@cache
def block(index: int) -> tuple[Mesh, float, float]:
    """A block of flats or an old town house: mesh, width along x, depth along z, metres."""
    rng = np.random.default_rng([_LIBRARY_SEED, 1, index])
    width, depth = float(rng.uniform(10.0, 26.0)), float(rng.uniform(9.0, 13.0))
    height = float(rng.integers(3, 6)) * 3.15 + float(rng.uniform(0.3, 1.2))
    wall = _WALLS[int(rng.integers(len(_WALLS)))]
    front = 0.5 * depth
    parts = [
        box(
            (-0.5 * width, 0.0, -front),
            (0.5 * width, -height, front),
            material=Material.FACADE,
            colour=wall,
            open_bottom=True,
        )
    ]
    plinth = tuple(0.55 * value for value in wall)
    parts.append(
        box(
            (-0.5 * width - 0.03, 0.0, -front),
            (0.5 * width + 0.03, -0.7, front + 0.05),
            material=Material.CONCRETE,
            colour=plinth,
        )
    )  # type: ignore[arg-type]
    if rng.random() < 0.6:
        parts.append(
            _gable_roof(
                width, depth, height, rise=float(rng.uniform(2.5, 4.5)), colour=_ROOFS[int(rng.integers(4))], wall=wall
            )
        )
    else:
        parts.append(
            box(
                (-0.5 * width - 0.2, -height, -front - 0.2),
                (0.5 * width + 0.2, -height - 0.5, front + 0.25),
                material=Material.CONCRETE,
                colour=(0.3, 0.3, 0.29),
            )
        )
    if rng.random() < 0.5:
        parts += _shop_front(width, front, rng)
    if rng.random() < 0.4:
        bay = float(rng.uniform(3.0, 4.5))
        for x in np.arange(-0.5 * width + 2.0, 0.5 * width - 2.0, bay):
            for storey in range(1, int(height // 3.15)):
                y = -3.15 * storey
                parts.append(
                    box(
                        (x - 1.1, y, front),
                        (x + 1.1, y - 0.15, front + 1.1),
                        material=Material.CONCRETE,
                        colour=(0.4, 0.4, 0.38),
                    )
                )
                parts.append(
                    box(
                        (x - 1.1, y - 0.15, front + 1.02),
                        (x + 1.1, y - 1.0, front + 1.1),
                        material=Material.METAL,
                        colour=(0.2, 0.2, 0.21),
                    )
                )
    for x in rng.uniform(-0.4 * width, 0.4 * width, 2):
        parts.append(
            box(
                (x - 0.35, -height, -0.5),
                (x + 0.35, -height - 5.2, 0.3),
                material=Material.CONCRETE,
                colour=(0.22, 0.12, 0.09),
            )
        )
    door = float(rng.uniform(-0.4, 0.4)) * width
    parts.append(
        box(
            (door - 0.75, 0.0, front),
            (door + 0.75, -2.4, front + 0.08),
            material=Material.MATTE,
            colour=(0.08, 0.05, 0.03),
        )
    )
    parts += front_details(width, front, height, np.random.default_rng([_LIBRARY_SEED, 11, index]))
    return join(parts), width, depth


def _shop_front(width: float, front: float, rng: np.random.Generator) -> list[Mesh]:
    parts = []
    x = -0.5 * width + 0.6
    sign = tuple(
        float(value)
        for value in rng.choice(
            [[0.5, 0.05, 0.04], [0.04, 0.1, 0.3], [0.5, 0.36, 0.03], [0.06, 0.25, 0.08], [0.5, 0.5, 0.48]]
        )
    )
    while x + 3.0 < 0.5 * width:
        wide = float(rng.uniform(2.2, 3.6))
        parts.append(
            box((x, -0.4, front), (x + wide, -2.5, front + 0.06), material=Material.GLASS, colour=(0.04, 0.045, 0.05))
        )
        x += wide + 0.5
    parts.append(
        box(
            (-0.5 * width + 0.5, -2.75, front),
            (0.5 * width - 0.5, -3.3, front + 0.15),
            material=Material.SIGN,
            colour=sign,
        )
    )  # type: ignore[arg-type]
    if rng.random() < 0.5:
        parts.append(
            box(
                (-0.5 * width + 0.8, -2.6, front),
                (0.2 * width, -2.68, front + 1.4),
                material=Material.CLOTH,
                colour=sign,
            )
        )  # type: ignore[arg-type]
    return parts


@cache
def house(index: int) -> tuple[Mesh, float, float]:
    """A family house with a gable or hipped look: mesh, width, depth."""
    rng = np.random.default_rng([_LIBRARY_SEED, 2, index])
    width, depth = float(rng.uniform(8.0, 13.0)), float(rng.uniform(8.0, 11.0))
    height = float(rng.uniform(3.4, 6.4))
    wall = _WALLS[int(rng.integers(len(_WALLS)))]
    roof = _ROOFS[int(rng.integers(4))]
    body = [
        box(
            (-0.5 * width, 0.0, -0.5 * depth),
            (0.5 * width, -height, 0.5 * depth),
            material=Material.FACADE,
            colour=wall,
            open_bottom=True,
        ),
        _gable_roof(width, depth, height, rise=float(rng.uniform(2.5, 4.5)), colour=roof, wall=wall),
    ]
    x = float(rng.uniform(-0.3, 0.3)) * width
    body.append(
        box(
            (x - 0.3, -height - 1.5, 0.5),
            (x + 0.3, -height - 4.6, 1.1),
            material=Material.CONCRETE,
            colour=(0.2, 0.11, 0.08),
        )
    )
    door = float(rng.uniform(-0.35, 0.35)) * width
    body.append(
        box(
            (door - 0.55, 0.0, 0.5 * depth),
            (door + 0.55, -2.1, 0.5 * depth + 0.06),
            material=Material.MATTE,
            colour=(0.12, 0.08, 0.05),
        )
    )
    body.append(
        box(
            (door - 0.9, -2.3, 0.5 * depth),
            (door + 0.9, -2.42, 0.5 * depth + 1.0),
            material=Material.CONCRETE,
            colour=roof,
        )
    )
    if rng.random() < 0.4:
        side = float(rng.choice([-1.0, 1.0]))
        a, b = sorted((side * 0.5 * width, side * (0.5 * width + 3.2)))
        body.append(box((a, 0.0, -0.3 * depth), (b, -2.6, 0.4 * depth), material=Material.CONCRETE, colour=wall))
        body.append(
            box(
                (a + 0.3, 0.0, 0.4 * depth),
                (b - 0.3, -2.2, 0.4 * depth + 0.05),
                material=Material.METAL,
                colour=(0.3, 0.3, 0.31),
            )
        )
        width += 6.4
    mesh = join(body)
    if rng.random() < 0.35:
        turned = mesh.positions[:, [2, 1, 0]] * np.array([1.0, 1.0, -1.0], dtype=np.float32)
        normals = mesh.normals[:, [2, 1, 0]] * np.array([1.0, 1.0, -1.0], dtype=np.float32)
        mesh = Mesh(turned, normals, mesh.colours, mesh.materials, mesh.triangles)
        width, depth = depth, width
    return mesh, width, depth


@cache
def hall(index: int) -> tuple[Mesh, float, float]:
    """A long flat building (works, supermarket, institute): mesh, width, depth."""
    rng = np.random.default_rng([_LIBRARY_SEED, 3, index])
    width, depth, height = float(rng.uniform(22.0, 45.0)), float(rng.uniform(12.0, 20.0)), float(rng.uniform(4.5, 11.0))
    wall = tuple(
        float(value)
        for value in rng.choice(
            [[0.5, 0.5, 0.5], [0.32, 0.34, 0.37], [0.05, 0.16, 0.3], [0.45, 0.4, 0.3], [0.6, 0.6, 0.58]]
        )
    )
    kind = Material.FACADE if rng.random() < 0.65 else Material.METAL
    front = 0.5 * depth
    parts = [
        box((-0.5 * width, 0.0, -front), (0.5 * width, -height, front), material=kind, colour=wall, open_bottom=True),  # type: ignore[arg-type]
        box(
            (-0.5 * width - 0.3, -height, -front - 0.3),
            (0.5 * width + 0.3, -height - 0.6, front + 0.3),
            material=Material.CONCRETE,
            colour=(0.25, 0.25, 0.25),
        ),
    ]
    for x in np.arange(-0.5 * width + 1.0, 0.5 * width - 4.0, float(rng.uniform(4.0, 7.0))):
        if rng.random() < 0.5:
            parts.append(
                box(
                    (x, -0.1, front), (x + 3.2, -3.2, front + 0.06), material=Material.GLASS, colour=(0.04, 0.05, 0.055)
                )
            )
    return join(parts), width, depth
