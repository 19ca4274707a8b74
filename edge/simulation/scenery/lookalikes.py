"""Things of a person's size and shape that are no person: what a detector that has learned upright blobs gets wrong.

Each stands on y = 0 with its front at +z. None of them carries a label.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise

import numpy as np

from edge.simulation.scene import Material, Mesh
from edge.simulation.scenery.plants import lumpy
from edge.simulation.solids import Rgb, box, disc, ellipsoid, join, rounded_loft, tube

_LIBRARY_SEED = 14_142
_STEEL: Rgb = (0.26, 0.27, 0.28)
_DARK: Rgb = (0.05, 0.055, 0.06)
_PAINTS: tuple[Rgb, ...] = (
    (0.6, 0.42, 0.02), (0.45, 0.03, 0.03), (0.03, 0.10, 0.36), (0.04, 0.18, 0.07), (0.55, 0.55, 0.53),
    (0.06, 0.065, 0.07), (0.28, 0.29, 0.29), (0.55, 0.22, 0.02), (0.12, 0.08, 0.05),
)  # fmt: skip
_BARKS: tuple[Rgb, ...] = (
    (0.11, 0.085, 0.065), (0.16, 0.14, 0.12), (0.07, 0.055, 0.045), (0.24, 0.20, 0.15), (0.45, 0.43, 0.39),
    (0.10, 0.11, 0.06), (0.17, 0.10, 0.06),
)  # fmt: skip
_GREENS: tuple[Rgb, ...] = ((0.05, 0.085, 0.02), (0.035, 0.065, 0.018), (0.095, 0.11, 0.03), (0.02, 0.045, 0.02))


def _pick(rng: np.random.Generator, colours: tuple[Rgb, ...]) -> Rgb:
    red, green, blue = np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.7, 1.3)
    return float(red), float(green), float(blue)


def _pole(height_m: float, radius_m: float, colour: Rgb, material: Material = Material.METAL) -> Mesh:
    return tube([(0, 0.1, 0), (0, -height_m, 0)], radius_m, material=material, colour=colour, sides=7)


def _street_tree(rng: np.random.Generator) -> Mesh:
    """A trunk as broad as a slim person, knots and a fork at head height, a sparse crown high up."""
    thick, stem = float(rng.uniform(0.07, 0.28)), float(rng.uniform(1.9, 3.4))
    bark = _pick(rng, _BARKS)
    bow = rng.normal(0.0, 0.08, 4)
    fork = np.array([bow[2], -stem, bow[3]])
    path = [(0, 0.1, 0), (bow[0], -0.5 * stem, bow[1]), tuple(fork)]
    parts = [tube(path, [1.35 * thick, thick, 0.85 * thick], material=Material.BARK, colour=bark, sides=9)]
    for _ in range(int(rng.integers(0, 3))):
        level, around = float(rng.uniform(0.4, 0.8)) * stem, float(rng.uniform(0, 6.3))
        knot = (0.9 * thick * np.cos(around), -level, 0.9 * thick * np.sin(around))
        size = thick * float(rng.uniform(0.3, 0.6))
        parts.append(ellipsoid(knot, (size, 1.3 * size, size), material=Material.BARK, colour=bark, sides=7, rings=4))
    for turn in np.arange(3) * 2.1 + rng.uniform(0, 6.3):
        reach = float(rng.uniform(0.5, 1.3))
        tip = fork + np.array([reach * np.cos(turn), -float(rng.uniform(1.2, 2.2)), reach * np.sin(turn)])
        parts.append(
            tube([tuple(fork), tuple(tip)], [0.6 * thick, 0.3 * thick], material=Material.BARK, colour=bark, sides=6)
        )
        size = float(rng.uniform(0.7, 1.3))
        crown = (size, 0.8 * size, size)
        green = _pick(rng, _GREENS)
        leaves = ellipsoid(tip, crown, material=Material.FOLIAGE, colour=green, sides=10, rings=6)
        parts.append(lumpy(leaves, rng, 0.16 * size))
    if rng.random() < 0.4:  # held by stakes
        for x, z in ((0.45, 0.1), (-0.45, 0.1)):
            stake = [(x, 0.1, z), (x, -1.7, z)]
            parts.append(tube(stake, 0.045, material=Material.BARK, colour=(0.25, 0.18, 0.11), sides=6))
        slat = box((-0.45, -1.5, 0.08), (0.45, -1.6, 0.12), material=Material.BARK, colour=(0.25, 0.18, 0.11))
        parts.append(slat)
    return join(parts)


def _bin_on_post(rng: np.random.Generator) -> Mesh:
    """A litter bin at the height of a trunk, on a post that may carry a plate where a head would be."""
    colour, base = _pick(rng, _PAINTS), float(rng.uniform(0.45, 0.75))
    height, half = float(rng.uniform(0.4, 0.65)), float(rng.uniform(0.15, 0.22))
    parts = [_pole(float(rng.uniform(base + height, 2.4)), 0.035, _STEEL)]
    can = [(0, -base, 0.12), (0, -base - height, 0.12)]
    sizes = np.array([(half, half), (1.1 * half, 1.1 * half)])
    parts.append(rounded_loft(can, sizes, material=Material.MATTE, colour=colour))
    if rng.random() < 0.5:
        top = -float(rng.uniform(1.5, 1.8))
        plate = _pick(rng, _PAINTS)
        parts.append(box((-0.14, top, 0.03), (0.14, top - 0.22, 0.06), material=Material.SIGN, colour=plate))
    return join(parts)


def _signs_on_pole(rng: np.random.Generator) -> Mesh:
    """Low plates stacked on a pole, from knee to above head height, some of them turned."""
    pole = float(rng.uniform(1.8, 3.2))
    parts = [_pole(pole, float(rng.uniform(0.03, 0.06)), _pick(rng, (_STEEL, _DARK, (0.4, 0.4, 0.4))))]
    level = -pole
    for _ in range(int(rng.integers(1, 4))):
        half_w, high = float(rng.uniform(0.12, 0.35)), float(rng.uniform(0.2, 0.6))
        face = float(rng.choice([-1.0, 1.0])) * 0.07
        colour = _pick(rng, _PAINTS)
        if rng.random() < 0.4:
            centre = (0.0, level + half_w, face)
            sign = 1.0 if face > 0 else -1.0
            parts.append(disc(centre, axis=2, radius=half_w, sign=sign, material=Material.SIGN, colour=colour))
            high = 2 * half_w
        else:
            low = (-half_w, level, min(face, 0.9 * face))
            parts.append(box(low, (half_w, level + high, face), material=Material.SIGN, colour=colour))
            bar = (-0.7 * half_w, level + 0.4 * high, face * 1.12), (0.7 * half_w, level + 0.6 * high, face)
            parts.append(box(*bar, material=Material.SIGN, colour=_pick(rng, _PAINTS)))
        level += high + float(rng.uniform(0.03, 0.2))
        if level > -0.5:
            break
    return join(parts)


def _machine(rng: np.random.Generator) -> Mesh:
    """A parking or ticket machine, a letter box, a small cabinet: a slim box, often with a hood."""
    wide, deep = float(rng.uniform(0.2, 0.55)), float(rng.uniform(0.18, 0.4))
    high, base = float(rng.uniform(1.0, 1.85)), float(rng.choice([0.0, 0.0, 0.5, 0.8]))
    colour = _pick(rng, _PAINTS)
    parts = [
        box((-0.5 * wide, -base, -0.5 * deep), (0.5 * wide, -high, 0.5 * deep), material=Material.METAL, colour=colour)
    ]
    if base > 0.0:
        parts.append(_pole(base + 0.1, 0.06, _DARK))
    front = 0.5 * deep + 0.006
    panel = (-0.32 * wide, -high + 0.45, front - 0.01), (0.32 * wide, -high + 0.12, front)
    parts.append(box(*panel, material=Material.SIGN, colour=_pick(rng, _PAINTS)))
    if rng.random() < 0.5:
        hood = (0.5 * wide + 0.03, 0.09, 0.5 * deep + 0.03)
        parts.append(ellipsoid((0, -high, 0), hood, material=Material.METAL, colour=_pick(rng, _PAINTS), rings=4))
    return join(parts)


def _pillar(rng: np.random.Generator) -> Mesh:
    """An advertising pillar or a gate post of stone."""
    if rng.random() < 0.5:
        half, high = float(rng.uniform(0.16, 0.28)), float(rng.uniform(1.3, 2.0))
        stone = _pick(rng, ((0.34, 0.32, 0.28), (0.28, 0.14, 0.10), (0.5, 0.48, 0.44)))
        cap = half + 0.05
        return join(
            [
                box((-half, 0.05, -half), (half, -high, half), material=Material.CONCRETE, colour=stone),
                box((-cap, -high, -cap), (cap, -high - 0.12, cap), material=Material.CONCRETE, colour=stone),
            ]
        )
    radius, high = float(rng.uniform(0.35, 0.65)), float(rng.uniform(2.4, 3.3))
    ring = np.full((2, 2), radius)
    grey: Rgb = (0.4, 0.4, 0.38)
    parts = [rounded_loft([(0, 0, 0), (0, -high, 0)], ring, material=Material.CONCRETE, colour=grey, squareness=2.0)]
    parts.append(rounded_loft([(0, -high, 0), (0, -high - 0.35, 0)], np.array([[radius + 0.08] * 2, [0.1, 0.1]]),
                              material=Material.METAL, colour=_DARK, squareness=2.0))  # fmt: skip
    for turn in np.arange(0.0, 6.0, 1.05):  # posters round it
        low = -float(rng.uniform(0.4, 1.2))
        top = low - float(rng.uniform(0.8, 1.3))
        angles = turn + np.linspace(0.0, 0.8, 4)
        colour = _pick(rng, _PAINTS)
        for a, b in pairwise(angles):
            reach = radius + 0.012
            path = np.array([[reach * np.cos(k), (low + top) / 2, reach * np.sin(k)] for k in (a, b)])
            low_corner = np.minimum(path[0], path[1]) - np.array([0.006, 0, 0.006])
            high_corner = np.maximum(path[0], path[1]) + np.array([0.006, 0, 0.006])
            low_corner[1], high_corner[1] = top, low
            parts.append(box(low_corner, high_corner, material=Material.SIGN, colour=colour))
    return join(parts)


def _barrier(rng: np.random.Generator) -> Mesh:
    """Works on the pavement: a striped beacon, a cone, or a board on two feet."""
    red, white = (0.55, 0.05, 0.03), (0.75, 0.75, 0.73)
    kind = int(rng.integers(3))
    if kind == 0:
        parts = [box((-0.4, 0.0, -0.2), (0.4, -0.12, 0.2), material=Material.RUBBER, colour=_DARK)]
        for row in range(7):
            low, colour = -0.18 - 0.15 * row, red if row % 2 else white
            parts.append(box((-0.13, low, -0.03), (0.13, low - 0.15, 0.03), material=Material.SIGN, colour=colour))
        lamp = (0.1, 0.1, 0.05)
        parts.append(ellipsoid((0, -1.32, 0), lamp, material=Material.LAMP, colour=(0.6, 0.35, 0.02), rings=4))
        return join(parts)
    if kind == 1:
        rings = [(0, -0.03, 0), (0, -0.35, 0), (0, -0.36, 0), (0, -0.52, 0), (0, -0.53, 0), (0, -0.75, 0)]
        radii = [0.17, 0.11, 0.11, 0.075, 0.075, 0.03]
        parts = [box((-0.2, 0.0, -0.2), (0.2, -0.04, 0.2), material=Material.RUBBER, colour=red)]
        for first, colour in ((0, red), (2, white), (4, red)):
            piece, size = rings[first : first + 2], radii[first : first + 2]
            parts.append(tube(piece, size, material=Material.SIGN, colour=colour, sides=9))
        return join(parts)
    parts = [_foot(x) for x in (-0.9, 0.9)]
    for number in range(8):
        x = -1.1 + 0.275 * number
        colour = red if number % 2 else white
        parts.append(box((x, -0.75, -0.02), (x + 0.275, -1.0, 0.02), material=Material.SIGN, colour=colour))
    return join(parts)


def _foot(x: float) -> Mesh:
    return box((x - 0.04, 0.0, -0.25), (x + 0.04, -0.95, 0.0), material=Material.METAL, colour=_STEEL)


def _slim_shrub(rng: np.random.Generator) -> Mesh:
    """A clipped thuja or a potted tree: a person's height and width, in leaves."""
    high, half, green = float(rng.uniform(1.1, 2.0)), float(rng.uniform(0.2, 0.4)), _pick(rng, _GREENS)
    foot = float(rng.choice([0.0, 0.4]))
    radii = (half, 0.5 * (high - foot), half)
    leaves = ellipsoid((0, -0.5 * (high + foot), 0), radii, material=Material.FOLIAGE, colour=green, sides=9, rings=6)
    if foot == 0.0:
        return leaves
    pot = np.array([(0.2, 0.2), (0.27, 0.27)])
    clay = _pick(rng, ((0.3, 0.12, 0.07), (0.3, 0.3, 0.29)))
    return join([leaves, rounded_loft([(0, 0, 0), (0, -0.45, 0)], pot, material=Material.CONCRETE, colour=clay)])


def _cloth_column(rng: np.random.Generator) -> Mesh:
    """A folded parasol, a covered bench or a sack: cloth that hangs like clothes."""
    colour = _pick(rng, _PAINTS)
    if rng.random() < 0.5:
        sizes = np.array([(0.09, 0.09), (0.17, 0.16), (0.13, 0.13), (0.05, 0.05)])
        shape = [(0, -0.75, 0), (0, -1.1, 0), (0, -1.8, 0), (0, -2.3, 0)]
        return join([_pole(2.4, 0.03, _STEEL), rounded_loft(shape, sizes, material=Material.CLOTH, colour=colour)])
    high = float(rng.uniform(0.6, 1.2))
    sizes = np.array([(0.3, 0.28), (0.34, 0.3), (0.22, 0.2), (0.08, 0.08)])
    shape = [(0, -share * high, 0) for share in (0.0, 0.4, 0.85, 1.0)]
    return rounded_loft(shape, sizes, material=Material.CLOTH, colour=colour)


def _board(rng: np.random.Generator) -> Mesh:
    """A pavement board or a poster stand, dark and bright patches above each other like clothes and a face."""
    half, high = float(rng.uniform(0.25, 0.6)), float(rng.uniform(0.9, 1.9))
    parts = [box((-half, 0.0, -0.05), (half, -high, 0.05), material=Material.SIGN, colour=_pick(rng, _PAINTS))]
    for face in (-0.06, 0.06):
        level = -0.1 * high
        while level > -0.85 * high:
            tall = float(rng.uniform(0.15, 0.45)) * high
            inner = float(rng.uniform(0.3, 0.85)) * half
            top = max(level - tall, -0.95 * high)
            patch = (-inner, level, 0.9 * face), (inner, top, face)
            parts.append(box(*patch, material=Material.SIGN, colour=_pick(rng, _PAINTS)))
            level = top - 0.04 * high
    return join(parts)


def _hydrant(rng: np.random.Generator) -> Mesh:
    """A hydrant, a bollard with a ball, or a stack of two balls: something with a head."""
    colour, high = _pick(rng, _PAINTS), float(rng.uniform(0.7, 1.15))
    half = float(rng.uniform(0.08, 0.16))
    material = Material.METAL if rng.random() < 0.6 else Material.CONCRETE
    post = tube([(0, 0.05, 0), (0, -0.8 * high, 0)], [1.2 * half, half], material=material, colour=colour, sides=9)
    head = ellipsoid((0, -0.88 * high, 0), (1.2 * half, 0.12 * high, 1.2 * half), material=material, colour=colour)
    reach = [(side * 1.9 * half, -0.6 * high, 0) for side in (-1.0, 1.0)]
    arms = tube(reach, 0.5 * half, material=material, colour=colour)
    return join([post, head, arms])


KINDS: dict[str, Callable[[np.random.Generator], Mesh]] = {
    "street_tree": _street_tree,
    "signs_on_pole": _signs_on_pole,
    "bin_on_post": _bin_on_post,
    "machine": _machine,
    "pillar": _pillar,
    "barrier": _barrier,
    "slim_shrub": _slim_shrub,
    "cloth_column": _cloth_column,
    "board": _board,
    "hydrant": _hydrant,
}
VARIANTS = 10


@cache
def lookalike(kind: str, index: int) -> Mesh:
    """Variant ``index`` (0 .. VARIANTS - 1) of one of `KINDS`."""
    return KINDS[kind](np.random.default_rng([_LIBRARY_SEED, list(KINDS).index(kind), index]))


@cache
def lookalike_base_wd(kind: str, index: int) -> tuple[float, float]:
    """Width and depth of what it covers up to two metres of height, metres."""
    mesh = lookalike(kind, index)
    low = mesh.positions[mesh.positions[:, 1] > -2.0]
    span = 2.0 * np.abs(low).max(axis=0)
    return float(max(span[0], 0.2)), float(max(span[2], 0.2))
