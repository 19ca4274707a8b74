"""Everything around the labelled objects: ground, buildings, plants, street furniture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.simulation.placing import Footprint, PlacedObject
from edge.simulation.planting.lookalikes import plant_lookalikes
from edge.simulation.planting.planter import Planter, Surroundings
from edge.simulation.planting.screens import hide_behind
from edge.simulation.planting.sides import plant_background, plant_side
from edge.simulation.road import Road, Street
from edge.simulation.scene import Instance
from edge.simulation.scenery import ground

FloatArray = NDArray[np.float64]
_SIDE_MIX = {
    "city": {"city": 0.75, "park": 0.15, "road": 0.1},
    "residential": {"residential": 0.75, "park": 0.15, "city": 0.1},
    "road": {"road": 0.5, "forest": 0.2, "city": 0.1, "park": 0.2},
    "forest": {"forest": 0.85, "road": 0.15},
    "campus": {"campus": 0.6, "park": 0.4},
}


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
    planter = Planter(world, road, street, rng, objects=objects if guard_views else (), span_s_m=span_s_m)
    for index, share in screens:
        hide_behind(planter, objects[index], share)
    kinds = {}
    for side in (1.0, -1.0):
        mix = _SIDE_MIX[street.kind]
        kinds[side] = str(rng.choice(list(mix), p=list(mix.values())))
        plant_side(planter, side, kinds[side])
    plant_background(planter)
    planter.rng = rng.spawn(1)[0]  # chance of their own: the rest of a seed's world stays as it is
    for side, kind in kinds.items():
        plant_lookalikes(planter, side, kind)
    return world


def _pad(item: PlacedObject) -> FloatArray:
    """Corners of the paved ground under an object off the street."""
    length_m, width_m = item.size_hwl[2] + 2.0, item.size_hwl[1] + 1.6
    return Footprint(item.location[0], item.location[2], item.yaw_rad, length_m=length_m, width_m=width_m).corners()


def _off_street(item: PlacedObject, road: Road, street: Street) -> bool:
    s, t = road.to_road(item.location[0], item.location[2])
    inside = street.left_edge_m - 0.6 < t < street.right_edge_m + 0.6
    return not inside and street.raised_at(s, t) >= 0.0
