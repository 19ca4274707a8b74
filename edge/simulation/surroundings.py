"""Everything around the labelled objects: ground, buildings, plants, street furniture, light."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from edge.simulation.placing import Footprint, PlacedObject
from edge.simulation.road import Road, Street
from edge.simulation.scene import Instance, Light, Mesh
from edge.simulation.scenery import buildings, furniture, ground, plants

FloatArray = NDArray[np.float64]
_COARSE_BEYOND_M = 45.0
_EYE_M = 1.66
_SIDE_MIX = {
    "city": {"city": 0.75, "park": 0.15, "road": 0.1},
    "residential": {"residential": 0.75, "park": 0.15, "city": 0.1},
    "road": {"road": 0.5, "forest": 0.2, "city": 0.1, "park": 0.2},
    "forest": {"forest": 0.85, "road": 0.15},
    "campus": {"campus": 0.6, "park": 0.4},
}


@dataclass(slots=True)
class Surroundings:
    """Meshes and instances of the unlabelled world."""

    meshes: dict[str, Mesh] = field(default_factory=dict)
    instances: list[Instance] = field(default_factory=list)


def build_surroundings(
    road: Road,
    street: Street,
    rng: np.random.Generator,
    *,
    objects: tuple[PlacedObject, ...],
    screens: tuple[tuple[int, float], ...] = (),
    span_s_m: tuple[float, float],
    guard_views: bool,
) -> Surroundings:
    """Scenery along a road.

    Args:
        road, street: the street.
        rng: source of chance.
        objects: what must stay free.
        screens: (index into objects, share of it to hide behind a trunk, a bush, a post or a box).
        span_s_m: stations between which scenery stands.
        guard_views: keep large things out of the lines of sight from the origin to the objects.
    """
    world = Surroundings()
    look = ground.GroundLook.draw(rng, street)
    pads = [
        (_pad(item), item.location[1])
        for item in objects
        if item.kind in ("Car", "Van", "Truck") and _off_street(item, road, street)
    ]
    world.meshes["ground"] = ground.joined(
        [
            ground.ground_mesh(road, street, look, from_s_m=span_s_m[0] - 5.0, to_s_m=span_s_m[1] + 60.0),
            ground.markings_mesh(road, street, look, rng, from_s_m=span_s_m[0] - 5.0, to_s_m=span_s_m[1] + 20.0),
            ground.pads_mesh(pads, look.parking),
        ]
    )
    world.instances.append(Instance("ground", np.eye(4), texture_seed=float(rng.uniform(0, 100))))
    planter = _Planter(world, road, street, rng, objects=objects if guard_views else (), span_s_m=span_s_m)
    for index, share in screens:
        planter.screen(objects[index], share)
    for side in (1.0, -1.0):
        mix = _SIDE_MIX[street.kind]
        planter.plant_side(side, str(rng.choice(list(mix), p=list(mix.values()))))
    planter.plant_background()
    return world


def _pad(item: PlacedObject) -> FloatArray:
    """Corners of the paved ground under an object off the street."""
    length_m, width_m = item.size_hwl[2] + 2.0, item.size_hwl[1] + 1.6
    return Footprint(item.location[0], item.location[2], item.yaw_rad, length_m=length_m, width_m=width_m).corners()


def _off_street(item: PlacedObject, road: Road, street: Street) -> bool:
    s, t = road.to_road(item.location[0], item.location[2])
    inside = street.left_edge_m - 0.6 < t < street.right_edge_m + 0.6
    return not inside and street.raised_at(s, t) >= 0.0


class _Planter:
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
        self._world, self._road, self._street, self._rng, self._span = world, road, street, rng, span_s_m
        self._bases = [
            Footprint(
                o.location[0], o.location[2], o.yaw_rad, length_m=o.size_hwl[2] + 0.5, width_m=o.size_hwl[1] + 0.5
            )
            for o in objects
        ]
        corners = [np.concatenate([base.corners(), [[base.x, base.z]]]) for base in self._bases]
        self._targets = np.concatenate(corners) if corners else np.zeros((0, 2))
        self._taken: list[Footprint] = []

    def _side_edge(self, side: float) -> float:
        return self._street.right_edge_m if side > 0 else self._street.left_edge_m

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
            guard: refuse where it would stand between the origin and an object.
            apart: keep its base clear of buildings, and count it as one.
            room_m: keep a square of this size clear of buildings.
            scale: size factor.

        Returns:
            Whether it was placed.
        """
        x, z = self._road.point(s, t)
        yaw = float(self._road.heading_at(s)) + turn_rad
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
        if apart:
            self._taken.append(base)
        y = float(self._road.height_at(s)) - self._street.raised_at(s, t) + sink_m
        cos, sin = np.cos(yaw) * scale, np.sin(yaw) * scale
        matrix = np.array([[cos, 0.0, sin, x], [0.0, scale, 0.0, y], [-sin, 0.0, cos, z], [0.0, 0.0, 0.0, 1.0]])
        self._world.meshes[name] = mesh
        self._world.instances.append(Instance(name, matrix, texture_seed=float(self._rng.uniform(0.0, 100.0))))
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

    def screen(self, item: PlacedObject, share: float) -> bool:
        """Put something beside the carriageway so that it hides about a share of an object as seen from the origin."""
        rng = self._rng
        away = float(np.hypot(item.location[0], item.location[2]))
        bearing = float(np.arctan2(item.location[0], item.location[2]))
        view = item.yaw_rad - bearing
        apparent = abs(np.cos(view)) * item.size_hwl[2] + abs(np.sin(view)) * item.size_hwl[1]
        for _ in range(40):
            name, mesh, width, height = self._screen_kind()
            nearness = float(rng.uniform(0.25, 0.92))
            if nearness * away > away - 0.5 * item.size_hwl[2] - 1.0:
                continue
            covered_height = (_EYE_M + (height - _EYE_M) / nearness) / item.size_hwl[0]
            need = share / float(np.clip(covered_height, 1e-3, 1.0))
            half_object, half_screen = 0.5 * apparent * nearness, 0.5 * width
            if covered_height <= 0.3 or need > 1.0 or half_screen < need * half_object:
                continue
            offset = float(rng.choice([-1.0, 1.0])) * (half_object + half_screen - 2.0 * need * half_object)
            x = nearness * away * np.sin(bearing) + offset * np.cos(bearing)
            z = nearness * away * np.cos(bearing) - offset * np.sin(bearing)
            s, t = self._road.to_road(float(x), float(z))
            if self._street.left_edge_m - 0.3 < t < self._street.right_edge_m + 0.3 or self._blocked_by_junction(
                s, 0.5
            ):
                continue
            turn = bearing - float(self._road.heading_at(s))
            if self.put(name, mesh, s=s, t=t, turn_rad=turn, size_wd=(max(width, 0.4), 0.5), guard=False):
                return True
        return False

    def _screen_kind(self) -> tuple[str, Mesh, float, float]:
        """A name, a mesh, its width across the view and its height."""
        rng = self._rng
        kind = int(rng.integers(6))
        if kind in (0, 1):
            index = int(rng.integers(plants.TREE_COUNT))
            return f"tree/{index}/False", plants.tree(index), 2.0 * plants.trunk_radius_m(index), 8.0
        if kind == 2:
            index = int(rng.integers(plants.BUSH_COUNT))
        elif kind == 3:
            index = int(rng.integers(plants.HEDGE_COUNT))
            mesh = plants.hedge(index)
            return f"hedge/{index}", mesh, plants.HEDGE_LENGTH_M, float(-mesh.positions[:, 1].min())
        elif kind == 4:
            index = int(rng.integers(9))
            mesh = furniture.bin_or_box(index)
            extent = mesh.positions.max(axis=0) - mesh.positions.min(axis=0)
            return f"bin/{index}", mesh, float(extent[0]), float(extent[1])
        else:
            return "mast", furniture.mast(), 0.24, 8.0
        mesh = plants.bush(index)
        extent = mesh.positions.max(axis=0) - mesh.positions.min(axis=0)
        return f"bush/{index}", mesh, 0.85 * float(extent[0]), 0.9 * float(extent[1])

    def plant_side(self, side: float, kind: str) -> None:
        """Fill one side of the street in the manner of ``kind``."""
        rng, street = self._rng, self._street
        front = abs(self._side_edge(side)) + street.verge_m + street.pavement_m
        self._furniture(side, kind)
        if kind == "city":
            self._buildings(
                side,
                front + float(rng.choice([0.1, 0.1, 1.5, 4.0])),
                library="block",
                gap=(0.0, 0.6) if rng.random() < 0.6 else (3.0, 12.0),
            )
            if rng.random() < 0.55:
                self._tree_row(side, abs(self._side_edge(side)) + 0.9, spacing_m=float(rng.uniform(7.0, 14.0)))
        elif kind == "residential":
            setback = float(rng.uniform(2.0, 7.0))
            self._border(side, front + 0.4)
            self._buildings(side, front + setback, library="house", gap=(3.0, 10.0))
            self._scatter_trees(side, front + 1.5, front + setback + 14.0, per_100_m=float(rng.uniform(6, 16)))
        elif kind == "road":
            self._buildings(
                side,
                front + float(rng.uniform(10.0, 30.0)),
                library=str(rng.choice(["hall", "house", "block"])),
                gap=(8.0, 50.0),
            )
            self._scatter_trees(side, front + 2.0, front + 40.0, per_100_m=float(rng.uniform(4, 16)))
            if rng.random() < 0.4:
                self._tree_row(side, front + 1.8, spacing_m=float(rng.uniform(8.0, 16.0)))
            if rng.random() < 0.3:
                self._border(side, front + 1.0, fence_kind=3)
        elif kind == "forest":
            self._scatter_trees(side, front + 1.0, front + 12.0, per_100_m=float(rng.uniform(26, 40)), conifers=0.35)
            self._scatter_trees(side, front + 10.0, front + 26.0, per_100_m=30.0, conifers=0.4)
            self._wood_edge(side, front + 26.0)
        elif kind == "park":
            if rng.random() < 0.6:
                self._border(side, front + 0.5)
            self._scatter_trees(side, front + 1.5, front + 30.0, per_100_m=float(rng.uniform(14, 30)))
        else:
            self._buildings(side, front + float(rng.uniform(2.0, 15.0)), library="hall", gap=(6.0, 25.0))
            self._scatter_trees(side, front + 0.5, front + 18.0, per_100_m=float(rng.uniform(5, 14)))
            self._bicycles(side, front)

    def _buildings(self, side: float, front_m: float, *, library: str, gap: tuple[float, float]) -> None:
        rng = self._rng
        maker, count = {
            "block": (buildings.block, buildings.BLOCK_COUNT),
            "house": (buildings.house, buildings.HOUSE_COUNT),
            "hall": (buildings.hall, buildings.HALL_COUNT),
        }[library]
        s = self._span[0]
        while s < self._span[1] + 20.0:
            index = int(rng.integers(count))
            mesh, width, depth = maker(index)
            middle = s + 0.5 * width
            t = side * (front_m + 0.5 * depth + float(rng.uniform(0.0, 0.8 if library == "block" else 3.0)))
            crossed = any(
                abs(middle - centre) < self._street.junction_half_m + 0.5 * width + 1.0
                for centre in self._street.junction_s_m
            )
            if not crossed:
                self.put(
                    f"{library}/{index}",
                    mesh,
                    s=middle,
                    t=t,
                    turn_rad=-side * 0.5 * np.pi,
                    size_wd=(width, depth),
                    sink_m=0.05,
                    apart=True,
                )
            s = middle + 0.5 * width + float(rng.uniform(*gap)) if not crossed else s + 4.0

    def _any_tree(self, s: float, conifers: float) -> tuple[str, Mesh]:
        coarse = s > _COARSE_BEYOND_M and self._span[1] < 200.0
        if self._rng.random() < conifers:
            index = int(self._rng.integers(plants.CONIFER_COUNT))
            return f"conifer/{index}/{coarse}", plants.conifer(index, coarse)
        index = int(self._rng.integers(plants.TREE_COUNT))
        return f"tree/{index}/{coarse}", plants.tree(index, coarse)

    def _scatter_trees(
        self, side: float, near_m: float, far_m: float, *, per_100_m: float, conifers: float = 0.15
    ) -> None:
        rng = self._rng
        count = int(rng.poisson(per_100_m * (self._span[1] - self._span[0]) / 100.0))
        for _ in range(count):
            s = float(rng.uniform(self._span[0], self._span[1]))
            t = side * (near_m + (far_m - near_m) * float(rng.random()) ** 1.3)
            if self._blocked_by_junction(s, 1.5):
                continue
            if rng.random() < 0.25:
                index = int(rng.integers(plants.BUSH_COUNT))
                self.put(
                    f"bush/{index}",
                    plants.bush(index),
                    s=s,
                    t=t,
                    turn_rad=float(rng.uniform(0, 6.3)),
                    size_wd=(1.6, 1.6),
                    room_m=2.5,
                )
            else:
                name, mesh = self._any_tree(s, conifers)
                wide = 2.5 if name.startswith("conifer") else 0.5
                self.put(
                    name,
                    mesh,
                    s=s,
                    t=t,
                    turn_rad=float(rng.uniform(0, 6.3)),
                    size_wd=(wide, wide),
                    room_m=5.0,
                    scale=float(rng.uniform(0.8, 1.25)),
                )

    def _tree_row(self, side: float, t_m: float, *, spacing_m: float) -> None:
        rng = self._rng
        index = int(rng.integers(plants.TREE_COUNT))
        for s in np.arange(self._span[0] + float(rng.uniform(0, spacing_m)), self._span[1], spacing_m):
            if self._blocked_by_junction(float(s), 2.0):
                continue
            coarse = s > _COARSE_BEYOND_M and self._span[1] < 200.0
            self.put(
                f"tree/{index}/{coarse}",
                plants.tree(index, coarse),
                s=float(s + rng.normal(0, 0.4)),
                t=side * t_m,
                turn_rad=float(rng.uniform(0, 6.3)),
                size_wd=(0.5, 0.5),
                room_m=1.5,
                scale=float(rng.uniform(0.85, 1.15)),
                guard=bool(rng.random() < 0.8),
            )

    def _wood_edge(self, side: float, t_m: float) -> None:
        for s in np.arange(self._span[0], self._span[1] + 40.0, 36.0):
            index = int(self._rng.integers(3))
            self.put(
                f"tree_line/{index}",
                plants.tree_line(index),
                s=float(s),
                t=side * t_m,
                turn_rad=0.5 * np.pi,
                size_wd=(40.0, 5.0),
            )

    def _border(self, side: float, t_m: float, *, fence_kind: int | None = None) -> None:
        rng = self._rng
        hedge = fence_kind is None and rng.random() < 0.5
        index = int(rng.integers(plants.HEDGE_COUNT if hedge else 3))
        step = plants.HEDGE_LENGTH_M if hedge else furniture.FENCE_LENGTH_M
        for s in np.arange(self._span[0], self._span[1] - step, step):
            if (rng.random() < 0.15 and fence_kind is None) or self._blocked_by_junction(float(s), step):
                continue
            if hedge:
                name, mesh = f"hedge/{index}", plants.hedge(index)
            else:
                number = index if fence_kind is None else fence_kind
                name, mesh = f"fence/{number}", furniture.fence(number)
            self.put(name, mesh, s=float(s), t=side * t_m, turn_rad=0.5 * np.pi, size_wd=(step, 0.7))

    def _blocked_by_junction(self, s: float, margin_m: float) -> bool:
        return any(abs(s - centre) < self._street.junction_half_m + margin_m for centre in self._street.junction_s_m)

    def _furniture(self, side: float, kind: str) -> None:
        rng, street = self._rng, self._street
        edge = abs(self._side_edge(side))
        across = 0.0 if side > 0 else np.pi
        if kind not in ("forest",) and rng.random() < 0.7:
            index = int(rng.integers(3))
            spacing = float(rng.uniform(22.0, 38.0))
            for s in np.arange(self._span[0] + float(rng.uniform(0, spacing)), self._span[1], spacing):
                self.put(
                    f"lamp/{index}",
                    furniture.lamp_post(index),
                    s=float(s),
                    t=side * (edge + 0.6),
                    turn_rad=across,
                    size_wd=(0.3, 0.3),
                )
        if rng.random() < 0.12:
            for s in np.arange(self._span[0] + float(rng.uniform(0, 30)), self._span[1], 32.0):
                self.put(
                    "mast", furniture.mast(), s=float(s), t=side * (edge + 1.2), turn_rad=across, size_wd=(0.4, 0.4)
                )
        for _ in range(int(rng.poisson((self._span[1] - self._span[0]) / (45.0 if side > 0 else 90.0)))):
            index = int(rng.integers(furniture.SIGN_COUNT))
            s = float(rng.uniform(self._span[0] + 5.0, self._span[1]))
            turn = float(rng.normal(0.0, 0.15)) + (0.0 if side > 0 or rng.random() < 0.3 else np.pi)
            self.put(
                f"sign/{index}",
                furniture.sign(index),
                s=s,
                t=side * (edge + float(rng.uniform(0.5, 1.2))),
                turn_rad=turn,
                size_wd=(0.3, 0.3),
            )
        if street.pavement_m > 0 and rng.random() < 0.3:
            index, spacing = int(rng.integers(2)), float(rng.uniform(1.6, 3.0))
            start = float(rng.uniform(self._span[0], self._span[1] - 30.0))
            for s in np.arange(start, start + float(rng.uniform(8.0, 40.0)), spacing):
                self.put(
                    f"bollard/{index}",
                    furniture.bollard(index),
                    s=float(s),
                    t=side * (edge + 0.35),
                    turn_rad=0.0,
                    size_wd=(0.3, 0.3),
                )
        if street.pavement_m > 0:
            for _ in range(int(rng.poisson((self._span[1] - self._span[0]) / 50.0))):
                index = int(rng.integers(9))
                s = float(rng.uniform(self._span[0], self._span[1]))
                self.put(
                    f"bin/{index}",
                    furniture.bin_or_box(index),
                    s=s,
                    t=side * (edge + street.verge_m + street.pavement_m - 0.4),
                    turn_rad=-side * 0.5 * np.pi,
                    size_wd=(1.6, 0.7),
                )
        if street.pavement_m > 0 and rng.random() < 0.12:
            s = float(rng.uniform(15.0, 60.0))
            self.put(
                "shelter",
                furniture.shelter(),
                s=s,
                t=side * (edge + street.verge_m + street.pavement_m + 0.2),
                turn_rad=side * 0.5 * np.pi,
                size_wd=(4.0, 1.6),
            )
        for centre in street.junction_s_m:
            if rng.random() < 0.4:
                s = centre - street.junction_half_m - 1.0 if side > 0 else centre + street.junction_half_m + 1.0
                self.put(
                    "traffic_light",
                    furniture.traffic_light(),
                    s=s,
                    t=side * (edge + 0.7),
                    turn_rad=across,
                    size_wd=(0.4, 0.4),
                )
        if kind == "city" and rng.random() < 0.35:
            self._bicycles(side, edge + street.verge_m + 0.8)

    def _bicycles(self, side: float, t_m: float) -> None:
        rng = self._rng
        start = float(rng.uniform(self._span[0] + 8.0, self._span[0] + 60.0))
        for number in range(int(rng.integers(3, 12))):
            index = int(rng.integers(6))
            s = start + 0.65 * number + float(rng.normal(0, 0.06))
            self.put(
                f"bicycle/{index}",
                furniture.parked_bicycle(index),
                s=s,
                t=side * (t_m + 0.6),
                turn_rad=float(rng.normal(0, 0.1)),
                size_wd=(1.8, 0.5),
            )

    def plant_background(self) -> None:
        """Woods and houses at the end of the view, so that the horizon is rarely bare."""
        rng = self._rng
        end = self._span[1]
        for t in np.arange(-150.0, 151.0, 37.0):
            if rng.random() < 0.85:
                index = int(rng.integers(3))
                away = float(rng.uniform(15.0, 45.0))
                if abs(t) > 14.0 or rng.random() < 0.6:
                    self.put(
                        f"tree_line/{index}",
                        plants.tree_line(index),
                        s=end + away,
                        t=float(t),
                        turn_rad=0.0,
                        size_wd=(40.0, 5.0),
                        guard=False,
                        scale=float(rng.uniform(0.9, 1.6)),
                    )
        for side in (-1.0, 1.0):
            for s in np.arange(max(self._span[0], 10.0), end + 20.0, 37.0):
                if rng.random() < 0.6:
                    index = int(rng.integers(3))
                    self.put(
                        f"tree_line/{index}",
                        plants.tree_line(index),
                        s=float(s),
                        t=side * float(rng.uniform(48.0, 90.0)),
                        turn_rad=0.5 * np.pi,
                        size_wd=(40.0, 5.0),
                        scale=float(rng.uniform(0.8, 1.3)),
                    )


def draw_light(rng: np.random.Generator) -> Light:
    """Sun, sky and air of a random day."""
    azimuth = float(rng.uniform(0.0, 2.0 * np.pi))
    elevation = float(np.radians(rng.uniform(14.0, 62.0)))
    towards_sun = np.array(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    weather = rng.choice(3, p=[0.6, 0.2, 0.2])
    cloud = float((rng.uniform(0.0, 0.3), rng.uniform(0.3, 0.65), rng.uniform(0.7, 1.0))[int(weather)])
    low = np.clip((np.degrees(elevation) - 10.0) / 35.0, 0.0, 1.0)
    strength = float(rng.uniform(2.4, 4.2))
    sun = (strength, strength * (0.80 + 0.14 * low), strength * (0.62 + 0.24 * low))
    sky = float(rng.uniform(0.75, 1.2))
    zenith = (0.22 * sky, 0.42 * sky, 0.80 * sky)
    grey = 0.75 * sky
    mix = cloud**1.5
    zenith = tuple(float((1 - mix) * value + mix * grey) for value in zenith)
    horizon = tuple(float(sky * value) for value in (0.78, 0.86, 0.95))
    haze = float(np.exp(rng.uniform(np.log(0.0003), np.log(0.005))))
    return Light(towards_sun, sun, zenith, horizon, cloud_cover=cloud, haze_per_m=haze)  # type: ignore[arg-type]
