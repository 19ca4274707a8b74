"""A fixed library of trees, conifers, bushes and hedges, each in a fine and a coarse version."""

from __future__ import annotations

from functools import cache

import numpy as np

from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import Rgb, ellipsoid, join, surface_grid, tube

_LIBRARY_SEED = 27_182
TREE_COUNT, CONIFER_COUNT, BUSH_COUNT, HEDGE_COUNT = 12, 4, 5, 5
HEDGE_LENGTH_M = 5.0
_GREENS: tuple[Rgb, ...] = (
    (0.050, 0.085, 0.020),
    (0.075, 0.105, 0.025),
    (0.035, 0.065, 0.018),
    (0.095, 0.110, 0.030),
    (0.060, 0.075, 0.022),
    (0.14, 0.10, 0.03),
)
_BARKS: tuple[Rgb, ...] = ((0.11, 0.085, 0.065), (0.16, 0.14, 0.12), (0.07, 0.055, 0.045))


def lumpy(mesh: Mesh, rng: np.random.Generator, amount: float) -> Mesh:
    """Points moved along smooth random waves, so that blobs lose their roundness."""
    waves = rng.normal(0.0, 2.0, (3, 3))
    phases = rng.uniform(0.0, 6.3, 3)
    shift = sum(np.sin(mesh.positions @ wave + phase) for wave, phase in zip(waves, phases, strict=True))
    positions = mesh.positions + mesh.normals * (amount * shift[:, None]).astype(np.float32)
    return Mesh(positions.astype(np.float32), mesh.normals, mesh.colours, mesh.materials, mesh.triangles)


def _shade(colour: Rgb, rng: np.random.Generator) -> Rgb:
    red, green, blue = np.array(colour) * rng.uniform(0.75, 1.25)
    return float(red), float(green), float(blue)


def _stem_radius_m(height_m: float) -> float:
    return 0.012 * height_m + 0.06


def trunk_radius_m(index: int) -> float:
    """Radius of a tree's stem at breast height."""
    return _stem_radius_m(float(np.random.default_rng([_LIBRARY_SEED, 1, index]).uniform(6.0, 13.0)))


@cache
def tree(index: int, coarse: bool = False) -> Mesh:
    """A leafy tree of 6 to 13 m with a clear stem."""
    rng = np.random.default_rng([_LIBRARY_SEED, 1, index])
    height = float(rng.uniform(6.0, 13.0))
    stem = float(rng.uniform(2.4, 3.6))
    spread = float(rng.uniform(0.26, 0.42)) * height
    green = _GREENS[index % len(_GREENS)]
    bark = _BARKS[int(rng.integers(3))]
    thick = _stem_radius_m(height)
    lean = rng.normal(0.0, 0.12, 2)
    parts = [
        tube(
            [(0, 0.1, 0), (0.3 * lean[0], -0.5 * stem, 0.3 * lean[1]), (lean[0], -stem - 1.0, lean[1])],
            [thick * 1.3, thick, 0.7 * thick],
            material=Material.BARK,
            colour=bark,
            sides=5 if coarse else 8,
        )
    ]
    blobs = 5 if coarse else int(rng.integers(15, 21))
    sides, rings = (7, 4) if coarse else (8, 5)
    crown_half = 0.5 * (height - stem)
    middle = np.array([lean[0], -(stem + crown_half), lean[1]])
    core = (0.62 * spread, 0.72 * crown_half, 0.62 * spread)
    parts.append(ellipsoid(middle, core, material=Material.FOLIAGE, colour=_shade(green, rng), sides=8, rings=5))
    widest = rng.uniform(-0.45, 0.1)  # where along the crown it is broadest
    for number in range(blobs):
        around = number * 2.39996 + rng.normal(0.0, 0.35)  # golden angle: evenly about the stem
        level = -0.9 + 1.8 * (number + 0.5) / blobs
        girth = np.sqrt(max(1.0 - (level - widest) ** 2 / (1.0 + abs(widest)) ** 2, 0.05))
        out = spread * girth * rng.uniform(0.45, 0.85)
        centre = middle + np.array([out * np.cos(around), -level * crown_half * 0.92, out * np.sin(around)])
        size = spread * rng.uniform(0.24, 0.42) * (1.7 if coarse else 1.0)
        radii = (size, size * rng.uniform(0.55, 0.95), size)
        blob = ellipsoid(centre, radii, material=Material.FOLIAGE, colour=_shade(green, rng), sides=sides, rings=rings)
        parts.append(lumpy(blob, rng, 0.14 * size))
        if not coarse and number % 5 == 0:
            path = [(lean[0], -stem + 0.3, lean[1]), centre]
            parts.append(tube(path, [0.5 * thick, 0.2 * thick], material=Material.BARK, colour=bark, sides=5))
    return join(parts)


@cache
def conifer(index: int, coarse: bool = False) -> Mesh:
    """A spruce or a poplar-like column."""
    rng = np.random.default_rng([_LIBRARY_SEED, 2, index])
    height = float(rng.uniform(8.0, 15.0))
    radius = float(rng.uniform(0.16, 0.24)) * height
    green = _shade((0.022, 0.045, 0.020), rng)
    parts = [tube([(0, 0.1, 0), (0, -0.6 * height, 0)], [0.2, 0.1], material=Material.BARK, colour=_BARKS[2], sides=6)]
    layers = 4 if coarse else 7
    sides = 9
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    for layer in range(layers):
        low = 0.8 + (height - 0.8) * layer / layers
        high = min(low + 1.7 * height / layers, height)
        wide = radius * (1.0 - layer / layers) * rng.uniform(0.9, 1.1)
        ring = np.zeros((3, sides + 1, 3))
        wobble = 1.0 + 0.18 * np.tile(rng.uniform(-1, 1, sides + 1), 1)
        wobble[-1] = wobble[0]
        for row, (level, size) in enumerate(((low, wide), (0.5 * (low + high), 0.55 * wide), (high, 0.02))):
            ring[row, :, 0] = size * wobble * np.cos(angle)
            ring[row, :, 1] = -level
            ring[row, :, 2] = size * wobble * np.sin(angle)
        parts.append(surface_grid(ring, materials=Material.FOLIAGE, colours=green))
    return join([parts[0]] + [_away_from_axis(part) for part in parts[1:]])


def _away_from_axis(mesh: Mesh) -> Mesh:
    wrong = np.einsum("ij,ij->i", mesh.normals[:, [0, 2]], mesh.positions[:, [0, 2]]).sum() < 0
    if not wrong:
        return mesh
    return Mesh(
        mesh.positions, -mesh.normals, mesh.colours, mesh.materials, np.ascontiguousarray(mesh.triangles[:, [0, 2, 1]])
    )


@cache
def bush(index: int) -> Mesh:
    """A low round shrub, 0.8 to 2.2 m."""
    rng = np.random.default_rng([_LIBRARY_SEED, 3, index])
    height = float(rng.uniform(0.8, 2.2))
    green = _GREENS[int(rng.integers(5))]
    parts = []
    for _ in range(5):
        x, z = rng.normal(0.0, 0.4 * height, 2)
        size = height * rng.uniform(0.35, 0.5)
        blob = ellipsoid(
            (x, -size * 0.9, z),
            (size, size, size),
            material=Material.FOLIAGE,
            colour=_shade(green, rng),
            sides=9,
            rings=5,
        )
        parts.append(lumpy(blob, rng, 0.07 * height))
    return join(parts)


@cache
def hedge(index: int) -> Mesh:
    """A trimmed hedge along x, five metres long."""
    rng = np.random.default_rng([_LIBRARY_SEED, 4, index])
    height, depth = float(rng.uniform(0.8, 1.9)), float(rng.uniform(0.5, 0.9))
    x = np.linspace(-0.5 * HEDGE_LENGTH_M, 0.5 * HEDGE_LENGTH_M, 9)
    profile = np.array(
        [(0.5, 0.0), (0.52, 0.4), (0.48, 0.85), (0.3, 1.0), (-0.3, 1.0), (-0.48, 0.85), (-0.52, 0.4), (-0.5, 0.0)]
    )
    points = np.zeros((len(profile), len(x), 3))
    points[..., 0] = x[None, :]
    points[..., 1] = -profile[:, 1:2] * height
    points[..., 2] = profile[:, 0:1] * depth
    points[1:-1] += rng.normal(0.0, 0.05, points[1:-1].shape)
    mesh = surface_grid(points, materials=Material.FOLIAGE, colours=_shade(_GREENS[index % 5], rng))
    if mesh.normals[:, 1].sum() > 0:
        mesh = surface_grid(points, materials=Material.FOLIAGE, colours=_shade(_GREENS[index % 5], rng), flip=True)
    return mesh


@cache
def tree_line(index: int) -> Mesh:
    """A far edge of woods: a lumpy wall along x, 40 m long, 8 to 14 m high."""
    rng = np.random.default_rng([_LIBRARY_SEED, 5, index])
    green = _GREENS[index % 5]
    parts = []
    for x in np.arange(-20.0, 20.0, 4.4):
        height = float(rng.uniform(7.0, 14.0))
        place = np.array([x + rng.normal(0.0, 0.6), 0.0, rng.normal(0.0, 1.5)])
        tone = _shade(green, rng)
        for level, size in ((0.3, 2.9), (0.55, 2.5), (0.66, 2.0), (0.84, 1.5)):
            centre = place + np.array([rng.normal(0.0, 1.1), -level * height, rng.normal(0.0, 0.6)])
            radii = (size * rng.uniform(0.8, 1.2), 0.2 * height * rng.uniform(0.8, 1.2), size)
            blob = ellipsoid(centre, radii, material=Material.FOLIAGE, colour=_shade(tone, rng), sides=7, rings=4)
            parts.append(lumpy(blob, rng, 0.22))
    return join(parts)
