"""Trees along the road: scattered, in rows, and the edge of a wood."""

from __future__ import annotations

import numpy as np

from edge.simulation.planting.planter import Planter
from edge.simulation.scene import Mesh
from edge.simulation.scenery import plants

_COARSE_BEYOND_M = 45.0


def _any_tree(planter: Planter, s: float, conifers: float) -> tuple[str, Mesh]:
    coarse = s > _COARSE_BEYOND_M and planter.span_s_m[1] < 200.0
    if planter.rng.random() < conifers:
        index = int(planter.rng.integers(plants.CONIFER_COUNT))
        return f"conifer/{index}/{coarse}", plants.conifer(index, coarse)
    index = int(planter.rng.integers(plants.TREE_COUNT))
    return f"tree/{index}/{coarse}", plants.tree(index, coarse)


def scatter_trees(
    planter: Planter, side: float, near_m: float, far_m: float, *, per_100_m: float, conifers: float = 0.15
) -> None:
    rng = planter.rng
    count = int(rng.poisson(per_100_m * (planter.span_s_m[1] - planter.span_s_m[0]) / 100.0))
    for _ in range(count):
        s = float(rng.uniform(planter.span_s_m[0], planter.span_s_m[1]))
        t = side * (near_m + (far_m - near_m) * float(rng.random()) ** 1.3)
        if planter.near_junction(s, 1.5):
            continue
        if rng.random() < 0.25:
            index = int(rng.integers(plants.BUSH_COUNT))
            planter.put(
                f"bush/{index}",
                plants.bush(index),
                s=s,
                t=t,
                turn_rad=float(rng.uniform(0, 6.3)),
                size_wd=(1.6, 1.6),
                room_m=2.5,
            )
        else:
            name, mesh = _any_tree(planter, s, conifers)
            wide = 2.5 if name.startswith("conifer") else 0.5
            planter.put(
                name,
                mesh,
                s=s,
                t=t,
                turn_rad=float(rng.uniform(0, 6.3)),
                size_wd=(wide, wide),
                room_m=5.0,
                scale=float(rng.uniform(0.8, 1.25)),
            )


def plant_tree_row(planter: Planter, side: float, t_m: float, *, spacing_m: float) -> None:
    """Trees of one kind, evenly spaced."""
    rng = planter.rng
    index = int(rng.integers(plants.TREE_COUNT))
    for s in np.arange(planter.span_s_m[0] + float(rng.uniform(0, spacing_m)), planter.span_s_m[1], spacing_m):
        if planter.near_junction(float(s), 2.0):
            continue
        coarse = s > _COARSE_BEYOND_M and planter.span_s_m[1] < 200.0
        planter.put(
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


def plant_wood_edge(planter: Planter, side: float, t_m: float) -> None:
    """A wall of trees far from the road."""
    for s in np.arange(planter.span_s_m[0], planter.span_s_m[1] + 40.0, 36.0):
        index = int(planter.rng.integers(3))
        planter.put(
            f"tree_line/{index}",
            plants.tree_line(index),
            s=float(s),
            t=side * t_m,
            turn_rad=0.5 * np.pi,
            size_wd=(40.0, 5.0),
        )
