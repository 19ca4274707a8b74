"""The fixed library of bodies that all drives draw from, each made once a process, named for the renderer's cache."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from edge.simulation.bodies.car import build_car
from edge.simulation.bodies.car_shapes import CAR_FAMILIES, CAR_FAMILY_SHARES, VAN_FAMILIES, VAN_FAMILY_SHARES, vary
from edge.simulation.bodies.cyclist import build_cyclist
from edge.simulation.bodies.person import PersonLook, build_person
from edge.simulation.bodies.truck import LOADS, build_truck
from edge.simulation.scene import Mesh
from edge.simulation.solids import extent_hwl

GAIT_PHASES = 8
BODY_COUNTS = {"Car": 72, "Van": 20, "Truck": 14, "Pedestrian": 24, "Cyclist": 16}
_LIBRARY_SEED = 20_110_926


@dataclass(frozen=True, slots=True)
class Body:
    """One variant of a class.

    Attributes:
        name: mesh name without the gait phase.
        kind: KITTI class.
        phases: mesh of each gait phase (one for vehicles).
        size_hwl: (h, w, l) of each phase, (P, 3) metres.
    """

    name: str
    kind: str
    phases: tuple[Mesh, ...]
    size_hwl: NDArray[np.float64]

    def mesh_name(self, phase: int) -> str:
        """The name of a phase's mesh in a scene."""
        return f"{self.name}/{phase}"

    @property
    def cycle_hwl(self) -> NDArray[np.float64]:
        """(h, w, l) that holds every phase."""
        return self.size_hwl.max(axis=0)


@cache
def body(kind: str, index: int) -> Body:
    """The library's body ``index`` of a class; the same on every machine and in every process."""
    kinds = list(BODY_COUNTS)
    rng = np.random.default_rng([_LIBRARY_SEED, kinds.index(kind), index])
    phases = _build(kind, index, rng)
    return Body(f"{kind}/{index:02d}", kind, phases, np.array([extent_hwl(mesh) for mesh in phases]))


def _spread(shares: tuple[float, ...], index: int, count: int) -> int:
    """Family of a member so that the library as a whole holds the shares."""
    return int(np.searchsorted(np.cumsum(shares) / np.sum(shares), (index + 0.5) / count))


def _build(kind: str, index: int, rng: np.random.Generator) -> tuple[Mesh, ...]:
    if kind == "Car":
        family = CAR_FAMILIES[_spread(CAR_FAMILY_SHARES, index, BODY_COUNTS[kind])]
        return (build_car(vary(family, rng)),)
    if kind == "Van":
        family = VAN_FAMILIES[_spread(VAN_FAMILY_SHARES, index, BODY_COUNTS[kind])]
        return (build_car(vary(family, rng)),)
    if kind == "Truck":
        size = (float(rng.uniform(2.9, 3.8)), float(rng.uniform(2.45, 2.7)), float(rng.uniform(6.5, 12.0)))
        return (build_truck(size, load=LOADS[min(index % 6, 5) % len(LOADS)], rng=rng),)
    look = PersonLook.draw(rng)
    steps = np.arange(GAIT_PHASES) / GAIT_PHASES
    if kind == "Pedestrian":
        if index % 5 == 4:
            return (build_person(look, 0.0, standing=True),)
        return tuple(build_person(look, float(step)) for step in steps)
    frame_colour = tuple(float(value) for value in rng.uniform(0.02, 0.4, 3))
    lean, helmet, basket = float(rng.uniform(0.2, 0.7)), bool(rng.random() < 0.35), bool(rng.random() < 0.3)
    return tuple(
        build_cyclist(look, float(step), frame_colour=frame_colour, lean_rad=lean, helmet=helmet, basket=basket)  # type: ignore[arg-type]
        for step in steps
    )


@cache
def spare_body(kind: str, index: int) -> Body:
    """A body of the wider wardrobe (see `edge.simulation.wardrobe`), of one phase: a pedestrian or a cyclist."""
    rng = np.random.default_rng([_LIBRARY_SEED, 7, list(BODY_COUNTS).index(kind), index])
    look, phase = PersonLook.draw_any(rng), float(rng.random())
    if kind == "Pedestrian":
        mesh = build_person(look, phase, standing=bool(rng.random() < 0.3))
    else:
        red, green, blue = (float(value) for value in rng.uniform(0.02, 0.5, 3))
        mesh = build_cyclist(
            look,
            phase,
            frame_colour=(red, green, blue),
            lean_rad=float(rng.uniform(0.1, 0.9)),
            helmet=bool(rng.random() < 0.35) and not look.hat,
            basket=bool(rng.random() < 0.3),
        )
    return Body(f"{kind}/spare{index:03d}", kind, (mesh,), extent_hwl(mesh)[None])


def bodies(kind: str) -> list[Body]:
    """All bodies of a class."""
    return [body(kind, index) for index in range(BODY_COUNTS[kind])]
