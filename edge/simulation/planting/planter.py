"""Places one mesh at a time beside the road, out of the way of objects and of lines of sight."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edge.simulation.placing import Footprint, PlacedObject
from edge.simulation.road import Road, Street
from edge.simulation.scene import Instance, Mesh

FloatArray = NDArray[np.float64]
_POINTS_AN_OBJECT = 5  # four corners and the middle


@dataclass(slots=True)
class Surroundings:
    """Meshes and instances of the unlabelled world."""

    meshes: dict[str, Mesh] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)


class Planter:
    """Puts library meshes along the road where they are in nobody's way."""

    def __init__(
        self,
        world: Surroundings,
        road: Road,
        street: Street,
        rng: np.random.Generator,
        *,
        objects: tuple[PlacedObject, ...],
        span_s_m: tuple[float, float],
    ) -> None:
        self._world, self.road, self.street, self.rng, self.span_s_m = world, road, street, rng, span_s_m
        self._bases = [
            Footprint(
                o.location[0], o.location[2], o.yaw_rad, length_m=o.size_hwl[2] + 0.5, width_m=o.size_hwl[1] + 0.5
            )
            for o in objects
        ]
        corners = [np.concatenate([base.corners(), [[base.x, base.z]]]) for base in self._bases]
        self._targets = np.concatenate(corners) if corners else np.zeros((0, 2))
        self._taken: list[Footprint] = []

    def side_edge(self, side: float) -> float:
        """t of the carriageway's edge on the right (1) or the left (-1)."""
        return self.street.right_edge_m if side > 0 else self.street.left_edge_m

    def put(
        self,
        name: str,
        mesh: Mesh,
        *,
        s: float,
        t: float,
        turn_rad: float,
        size_wd: tuple[float, float],
        sink_m: float = 0.0,
        guard: bool = True,
        whole_view: bool = False,
        apart: bool = False,
        room_m: float = 0.0,
        scale: float = 1.0,
    ) -> bool:
        """Place one mesh if its base is free.

        Args:
            name, mesh: what to place; its front, +z, turns by ``turn_rad`` from the road's direction.
            s, t: road coordinates.
            turn_rad: as above.
            size_wd: width and depth of its base.
            sink_m: how far below the ground it stands.
            guard: refuse where it would stand on the line from the origin to an object's middle or one of its corners.
            whole_view: refuse where it would stand before any part of an object.
            apart: keep its base clear of buildings, and count it as one.
            room_m: keep a square of this size clear of buildings.
            scale: size factor.

        Returns:
            Whether it was placed.
        """
        x, z = self.road.point(s, t)
        yaw = float(self.road.heading_at(s)) + turn_rad
        base = Footprint(x, z, yaw, length_m=size_wd[0], width_m=size_wd[1])
        if any(base.overlaps(other) for other in self._bases):
            return False
        if apart and any(base.overlaps(other) for other in self._taken):
            return False
        if room_m > 0.0:
            crown = Footprint(x, z, yaw, length_m=room_m, width_m=room_m)
            if any(crown.overlaps(other) for other in self._taken):
                return False
        if guard and self._hides(x, z, yaw, size_wd):
            return False
        if whole_view and self._stands_before(base):
            return False
        if apart:
            self._taken.append(base)
        y = float(self.road.height_at(s)) - self.street.raised_at(s, t) + sink_m
        cos, sin = np.cos(yaw) * scale, np.sin(yaw) * scale
        matrix = np.array([[cos, 0.0, sin, x], [0.0, scale, 0.0, y], [-sin, 0.0, cos, z], [0.0, 0.0, 0.0, 1.0]])
        self._world.meshes[name] = mesh
        self._world.instances.append(Instance(name, matrix, texture_seed=float(self.rng.uniform(0.0, 100.0))))
        return True

    def _hides(self, x: float, z: float, yaw: float, size_wd: tuple[float, float]) -> bool:
        """Whether the base lies on a straight line from the origin to an object (slab test in the base's frame)."""
        if not len(self._targets):
            return False
        cos, sin = np.cos(yaw), np.sin(yaw)
        turn = np.array([[cos, -sin], [sin, cos]])
        start = turn @ np.array([-x, -z])
        way = self._targets @ turn.T
        half = 0.5 * np.array(size_wd) + 0.05
        with np.errstate(divide="ignore", invalid="ignore"):
            low = (-half - start) / way
            high = (half - start) / way
        enter = np.nanmax(np.minimum(low, high), axis=1)
        leave = np.nanmin(np.maximum(low, high), axis=1)
        return bool(((enter < leave) & (enter < 1.0) & (leave > 0.0)).any())

    def _stands_before(self, base: Footprint) -> bool:
        """Whether the base covers any part of an object's bearings from nearer by."""
        if not len(self._targets):
            return False
        targets = self._targets.reshape(-1, _POINTS_AN_OBJECT, 2)
        bearings = np.arctan2(targets[..., 0], targets[..., 1])
        own = base.corners()
        own_bearings = np.arctan2(own[:, 0], own[:, 1])
        overlap = (own_bearings.min() < bearings.max(axis=1)) & (own_bearings.max() > bearings.min(axis=1))
        nearer = np.hypot(base.x, base.z) < np.hypot(targets[..., 0], targets[..., 1]).max(axis=1)
        return bool((overlap & nearer).any())

    def near_junction(self, s: float, margin_m: float) -> bool:
        """Whether a station lies in a crossing street or nearer to it than a margin."""
        return any(abs(s - centre) < self.street.junction_half_m + margin_m for centre in self.street.junction_s_m)
