"""What hides a labelled object in part: a trunk, a bush, a hedge, a box or a mast before it."""

from __future__ import annotations

import numpy as np

from edge.simulation.placing import PlacedObject
from edge.simulation.planting.planter import Planter
from edge.simulation.scene import Mesh
from edge.simulation.scenery import furniture, plants

_EYE_M = 1.66


def hide_behind(planter: Planter, item: PlacedObject, share: float) -> bool:
    """Put something beside the carriageway so that it hides about a share of an object as seen from the origin."""
    rng = planter.rng
    away = float(np.hypot(item.location[0], item.location[2]))
    bearing = float(np.arctan2(item.location[0], item.location[2]))
    view = item.yaw_rad - bearing
    apparent = abs(np.cos(view)) * item.size_hwl[2] + abs(np.sin(view)) * item.size_hwl[1]
    for _ in range(40):
        name, mesh, width, height = _screen_kind(planter)
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
        s, t = planter.road.to_road(float(x), float(z))
        if planter.street.left_edge_m - 0.3 < t < planter.street.right_edge_m + 0.3 or planter.near_junction(s, 0.5):
            continue
        turn = bearing - float(planter.road.heading_at(s))
        if planter.put(name, mesh, s=s, t=t, turn_rad=turn, size_wd=(max(width, 0.4), 0.5), guard=False):
            return True
    return False


def _screen_kind(planter: Planter) -> tuple[str, Mesh, float, float]:
    """A name, a mesh, its width across the view and its height."""
    rng = planter.rng
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
