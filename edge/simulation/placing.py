"""Objects placed in the world: size, body, pose; overlap tests and quick silhouettes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.simulation.bodies.library import Body, bodies
from edge.simulation.scene import Instance

FloatArray = NDArray[np.float64]

_PAINT_TONES = (
    ((0.30, 0.31, 0.32), 0.26), ((0.16, 0.17, 0.18), 0.13), ((0.012, 0.012, 0.014), 0.24), ((0.66, 0.66, 0.64), 0.10),
    ((0.015, 0.03, 0.10), 0.09), ((0.05, 0.11, 0.24), 0.05), ((0.28, 0.015, 0.015), 0.06), ((0.02, 0.07, 0.04), 0.03),
    ((0.30, 0.25, 0.17), 0.02), ((0.48, 0.36, 0.03), 0.01), ((0.10, 0.02, 0.03), 0.01),
)  # fmt: skip
_COMMERCIAL_TONES = (
    ((0.66, 0.66, 0.64), 0.45), ((0.30, 0.31, 0.32), 0.2), ((0.02, 0.025, 0.03), 0.1), ((0.48, 0.36, 0.03), 0.07),
    ((0.02, 0.05, 0.2), 0.1), ((0.35, 0.02, 0.015), 0.08),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class PlacedObject:
    """One labelled object at one moment.

    Attributes:
        kind: KITTI class.
        body: its mesh variant; phase: gait phase drawn.
        size_hwl: label size, metres.
        location: (3,) world bottom centre.
        yaw_rad: rotation about y, label convention (0 faces +x).
        tint: colour of paint or cloth.
        object_id: 1.. , the track id is one less.
        mesh_hwl: size of the drawn mesh before stretching to ``size_hwl``.
    """

    kind: str
    body: Body
    phase: int
    size_hwl: tuple[float, float, float]
    location: tuple[float, float, float]
    yaw_rad: float
    tint: tuple[float, float, float]
    object_id: int
    mesh_hwl: tuple[float, float, float]

    def world_from_model(self) -> FloatArray:
        """(4, 4): stretch of the library mesh to the label's size, turn, move."""
        height, width, length = (a / b for a, b in zip(self.size_hwl, self.mesh_hwl, strict=True))
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        matrix = np.eye(4)
        matrix[:3, :3] = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]) @ np.diag(
            [length, height, width]
        )
        matrix[:3, 3] = self.location
        return matrix

    def instance(self) -> Instance:
        """What the renderer draws."""
        return Instance(
            self.body.mesh_name(self.phase),
            self.world_from_model(),
            self.tint,
            self.object_id,
            float(self.object_id) * 1.37,
        )


def draw_size(kind: str, statistics: dict, rng: np.random.Generator) -> tuple[float, float, float]:  # type: ignore[type-arg]
    """(h, w, l) from a class's size statistics, metres."""
    entry = statistics["classes"][kind]
    low, high = np.array(entry["size_low"]), np.array(entry["size_high"])
    sample = rng.multivariate_normal(entry["size_mean"], entry["size_covariance"])
    height, width, length = np.clip(sample, low, high)
    return float(height), float(width), float(length)


def choose_body(
    kind: str, size_hwl: tuple[float, float, float], rng: np.random.Generator, *, whole_cycle: bool = False
) -> tuple[Body, int, tuple[float, float, float], tuple[float, float, float]]:
    """A body near a wanted size and its phase; the label size and the mesh size after limiting the stretch.

    Args:
        kind: KITTI class.
        size_hwl: wanted size.
        rng: source of chance.
        whole_cycle: measure walkers and riders over their whole gait (their size stays constant along a drive).
    """
    options = []
    for candidate in bodies(kind):
        if whole_cycle:
            options.append((candidate, int(rng.integers(len(candidate.phases))), candidate.cycle_hwl))
        else:
            options += [(candidate, phase, candidate.size_hwl[phase]) for phase in range(len(candidate.phases))]
    sizes = np.array([option[2] for option in options])
    distance = (np.abs(np.log(np.array(size_hwl) / sizes)) * np.array([1.0, 0.7, 1.0])).sum(axis=1)
    near = np.argsort(distance, kind="stable")[: max(4, len(options) // 8)]
    body, phase, own = options[int(rng.choice(near))]
    stretch = np.clip(np.array(size_hwl) / own, 0.84, 1.2)
    label = own * stretch
    return (
        body,
        phase,
        (float(label[0]), float(label[1]), float(label[2])),
        (float(own[0]), float(own[1]), float(own[2])),
    )


def draw_tint(kind: str, rng: np.random.Generator) -> tuple[float, float, float]:
    """A paint colour for vehicles, a slight shade for people."""
    if kind in ("Pedestrian", "Cyclist"):
        red, green, blue = rng.uniform(0.75, 1.2, 3)
        return float(red), float(green), float(blue)
    table = _COMMERCIAL_TONES if kind in ("Van", "Truck") and rng.random() < 0.7 else _PAINT_TONES
    shares = np.array([share for _, share in table])
    tone = np.array(table[int(rng.choice(len(table), p=shares / shares.sum()))][0])
    red, green, blue = np.clip(tone * rng.normal(1.0, 0.12) * rng.normal(1.0, 0.05, 3), 0.008, 0.8)
    return float(red), float(green), float(blue)


class Footprint:
    """The rectangle that a box covers on the ground; plain floats, since searches test many thousands a second."""

    __slots__ = ("cos", "half_length", "half_width", "sin", "x", "z")

    def __init__(self, x: float, z: float, yaw_rad: float, *, length_m: float, width_m: float) -> None:
        self.x, self.z = x, z
        self.cos, self.sin = math.cos(yaw_rad), math.sin(yaw_rad)
        self.half_length, self.half_width = 0.5 * length_m, 0.5 * width_m

    def corners(self) -> FloatArray:
        """Corners (4, 2), world x and z."""
        along = self.half_length * np.array([self.cos, -self.sin])
        across = self.half_width * np.array([self.sin, self.cos])
        centre = np.array([self.x, self.z])
        return np.array(
            [centre + along + across, centre + along - across, centre - along - across, centre - along + across]
        )

    def overlaps(self, other: Footprint) -> bool:
        """Whether the two rectangles share ground (separating axes: the sides of each)."""
        dx, dz = other.x - self.x, other.z - self.z
        reach = self.half_length + self.half_width + other.half_length + other.half_width
        if abs(dx) > reach or abs(dz) > reach:
            return False
        # cosine and sine between the two; half extents of one seen along the sides of the other
        same = abs(self.cos * other.cos + self.sin * other.sin)
        turned = abs(self.cos * other.sin - self.sin * other.cos)
        if abs(dx * self.cos - dz * self.sin) > self.half_length + other.half_length * same + other.half_width * turned:
            return False
        if abs(dx * self.sin + dz * self.cos) > self.half_width + other.half_length * turned + other.half_width * same:
            return False
        if (
            abs(dx * other.cos - dz * other.sin)
            > other.half_length + self.half_length * same + self.half_width * turned
        ):
            return False
        across = abs(dx * other.sin + dz * other.cos)
        return across <= other.half_width + self.half_length * turned + self.half_width * same


def _prism(low: tuple[float, ...], high: tuple[float, ...]) -> FloatArray:
    """Corners (8, 3) between a lower and an upper rectangle, each (rear x, front x, y, half width z), model shares."""
    corners = [
        (x, y, side * half) for rear, front, y, half in (low, high) for x in (rear, front) for side in (-1.0, 1.0)
    ]
    return np.array(corners)


_OUTLINES: dict[str, tuple[FloatArray, ...]] = {
    "Car": (
        _prism((-0.49, 0.49, -0.10, 0.46), (-0.49, 0.47, -0.50, 0.47)),
        _prism((-0.47, 0.30, -0.50, 0.47), (-0.46, 0.22, -0.66, 0.46)),
        _prism((-0.44, 0.22, -0.66, 0.45), (-0.28, 0.02, -0.99, 0.35)),
    ),
    "Van": (
        _prism((-0.49, 0.49, -0.08, 0.47), (-0.49, 0.48, -0.45, 0.48)),
        _prism((-0.49, 0.38, -0.45, 0.47), (-0.46, 0.22, -0.99, 0.41)),
    ),
    "Truck": (
        _prism((-0.49, 0.49, -0.16, 0.48), (-0.49, 0.49, -0.80, 0.48)),
        _prism((-0.49, 0.2, -0.80, 0.48), (-0.49, 0.2, -0.97, 0.48)),
    ),
    "Pedestrian": (
        _prism((-0.3, 0.3, 0.0, 0.25), (-0.1, 0.1, -0.5, 0.3)),
        _prism((-0.25, 0.25, -0.45, 0.42), (-0.2, 0.2, -0.83, 0.40)),
        _prism((-0.13, 0.15, -0.83, 0.15), (-0.13, 0.15, -1.0, 0.13)),
    ),
    "Cyclist": (
        _prism((-0.45, 0.45, 0.0, 0.04), (-0.45, 0.45, -0.35, 0.04)),
        _prism((-0.2, 0.15, -0.3, 0.2), (-0.2, 0.2, -0.62, 0.3)),
        _prism((-0.2, 0.25, -0.55, 0.36), (-0.05, 0.15, -0.98, 0.22)),
    ),
}


def silhouette_points(
    kind: str, size_hwl: tuple[float, float, float], location: FloatArray, yaw_rad: float
) -> list[FloatArray]:
    """World points (P, 3) of convex pieces whose union is about the object's outline."""
    cos, sin = np.cos(yaw_rad), np.sin(yaw_rad)
    turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
    size = np.array([size_hwl[2], size_hwl[0], size_hwl[1]])
    return [(piece * size) @ turn.T + location for piece in _OUTLINES[kind]]
