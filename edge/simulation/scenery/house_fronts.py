"""What hangs and stands on the ground floor of a house: doors, niches, posters, drainpipes, dummies behind glass.

Upright patches of a person's height, dark and bright above each other, against a wall: another thing that is no person.
"""

from __future__ import annotations

import numpy as np

from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import Rgb, box, tube

_DOORS: tuple[Rgb, ...] = (
    (0.08, 0.05, 0.03), (0.03, 0.08, 0.05), (0.25, 0.04, 0.03), (0.5, 0.5, 0.48), (0.05, 0.06, 0.1), (0.2, 0.12, 0.06),
)  # fmt: skip
_PRINTS: tuple[Rgb, ...] = (
    (0.55, 0.05, 0.04), (0.03, 0.1, 0.4), (0.6, 0.45, 0.05), (0.04, 0.22, 0.08), (0.65, 0.62, 0.58),
    (0.02, 0.02, 0.025), (0.5, 0.3, 0.22),
)  # fmt: skip


def _pick(rng: np.random.Generator, colours: tuple[Rgb, ...]) -> Rgb:
    red, green, blue = np.array(colours[int(rng.integers(len(colours)))]) * rng.uniform(0.75, 1.25)
    return float(red), float(green), float(blue)


def _door(x: float, front_m: float, rng: np.random.Generator) -> list[Mesh]:
    """A door in its frame, with a pane or a lighter upper half."""
    half, high = float(rng.uniform(0.4, 0.6)), float(rng.uniform(1.95, 2.3))
    colour, frame = _pick(rng, _DOORS), _pick(rng, ((0.5, 0.48, 0.44), (0.2, 0.18, 0.16)))
    low, top = (x - half, 0.0, front_m), (x + half, -high, front_m + 0.07)
    surround = box((x - half - 0.14, 0.0, front_m), (x + half + 0.14, -high - 0.16, front_m + 0.04),
                   material=Material.CONCRETE, colour=frame)  # fmt: skip
    parts = [surround, box(low, top, material=Material.MATTE, colour=colour)]
    if rng.random() < 0.6:
        pane = (x - 0.55 * half, -0.5 * high, front_m + 0.06), (x + 0.55 * half, -0.88 * high, front_m + 0.08)
        parts.append(box(*pane, material=Material.GLASS, colour=(0.05, 0.055, 0.06)))
    return parts


def _print(x: float, front_m: float, rng: np.random.Generator) -> list[Mesh]:
    """A poster or a dummy in a window: a frame, a body patch, a head patch."""
    half, base = float(rng.uniform(0.25, 0.5)), float(rng.uniform(0.4, 0.9))
    high = float(rng.uniform(0.9, 1.5))
    face = front_m + 0.09
    parts = [box((x - half, -base, front_m), (x + half, -base - high, face), material=Material.SIGN,
                 colour=_pick(rng, _PRINTS))]  # fmt: skip
    level = -base - 0.08 * high
    for share, breadth in ((0.4, 0.45), (0.3, 0.6), (0.16, 0.25)):
        tall = share * high * float(rng.uniform(0.8, 1.1))
        wide = breadth * half * float(rng.uniform(0.7, 1.2))
        shift = float(rng.normal(0.0, 0.05))
        patch = (x + shift - wide, level, face - 0.01), (x + shift + wide, level - tall, face + 0.012)
        parts.append(box(*patch, material=Material.SIGN, colour=_pick(rng, _PRINTS)))
        level -= tall
    return parts


def _pipe(x: float, front_m: float, height_m: float) -> Mesh:
    path = [(x, 0.0, front_m + 0.08), (x, -height_m, front_m + 0.08)]
    return tube(path, 0.06, material=Material.METAL, colour=(0.2, 0.21, 0.2), sides=6)


def front_details(width_m: float, front_m: float, height_m: float, rng: np.random.Generator) -> list[Mesh]:
    """Details of a front.

    Args:
        width_m: of the front, centred at x = 0.
        front_m: z of its wall.
        height_m: of its wall.
        rng: source of chance.
    """
    parts: list[Mesh] = [_pipe(side * (0.5 * width_m - 0.3), front_m, height_m) for side in (-1.0, 1.0)]
    free = np.arange(-0.5 * width_m + 1.2, 0.5 * width_m - 1.2, 1.9)
    rng.shuffle(free)
    count = min(len(free), 1 + int(rng.poisson(width_m / 7.0)))
    for x in free[:count]:
        parts += _door(float(x), front_m, rng) if rng.random() < 0.45 else _print(float(x), front_m, rng)
    return parts
