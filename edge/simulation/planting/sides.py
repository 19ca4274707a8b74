"""Fills a side of the street in the manner of a town, a suburb, a country road, a wood or a park."""

from __future__ import annotations

import numpy as np

from edge.simulation.planting.kerbside import furnish, park_bicycles
from edge.simulation.planting.planter import Planter
from edge.simulation.planting.trees import plant_tree_row, plant_wood_edge, scatter_trees
from edge.simulation.scenery import buildings, furniture, plants


def plant_side(planter: Planter, side: float, kind: str) -> None:
    """Fill one side of the street in the manner of ``kind``."""
    rng, street = planter.rng, planter.street
    front = abs(planter.side_edge(side)) + street.verge_m + street.pavement_m
    furnish(planter, side, kind)
    if kind == "city":
        plant_buildings(
            planter,
            side,
            front + float(rng.choice([0.1, 0.1, 1.5, 4.0])),
            library="block",
            gap=(0.0, 0.6) if rng.random() < 0.6 else (3.0, 12.0),
        )
        if rng.random() < 0.55:
            plant_tree_row(planter, side, abs(planter.side_edge(side)) + 0.9, spacing_m=float(rng.uniform(7.0, 14.0)))
    elif kind == "residential":
        setback = float(rng.uniform(2.0, 7.0))
        plant_border(planter, side, front + 0.4)
        plant_buildings(planter, side, front + setback, library="house", gap=(3.0, 10.0))
        scatter_trees(planter, side, front + 1.5, front + setback + 14.0, per_100_m=float(rng.uniform(6, 16)))
    elif kind == "road":
        plant_buildings(
            planter,
            side,
            front + float(rng.uniform(10.0, 30.0)),
            library=str(rng.choice(["hall", "house", "block"])),
            gap=(8.0, 50.0),
        )
        scatter_trees(planter, side, front + 2.0, front + 40.0, per_100_m=float(rng.uniform(4, 16)))
        if rng.random() < 0.4:
            plant_tree_row(planter, side, front + 1.8, spacing_m=float(rng.uniform(8.0, 16.0)))
        if rng.random() < 0.3:
            plant_border(planter, side, front + 1.0, fence_kind=3)
    elif kind == "forest":
        scatter_trees(planter, side, front + 1.0, front + 12.0, per_100_m=float(rng.uniform(26, 40)), conifers=0.35)
        scatter_trees(planter, side, front + 10.0, front + 26.0, per_100_m=30.0, conifers=0.4)
        plant_wood_edge(planter, side, front + 26.0)
    elif kind == "park":
        if rng.random() < 0.6:
            plant_border(planter, side, front + 0.5)
        scatter_trees(planter, side, front + 1.5, front + 30.0, per_100_m=float(rng.uniform(14, 30)))
    else:
        plant_buildings(planter, side, front + float(rng.uniform(2.0, 15.0)), library="hall", gap=(6.0, 25.0))
        scatter_trees(planter, side, front + 0.5, front + 18.0, per_100_m=float(rng.uniform(5, 14)))
        park_bicycles(planter, side, front)


def plant_buildings(planter: Planter, side: float, front_m: float, *, library: str, gap: tuple[float, float]) -> None:
    rng = planter.rng
    maker, count = {
        "block": (buildings.block, buildings.BLOCK_COUNT),
        "house": (buildings.house, buildings.HOUSE_COUNT),
        "hall": (buildings.hall, buildings.HALL_COUNT),
    }[library]
    s = planter.span_s_m[0]
    while s < planter.span_s_m[1] + 20.0:
        index = int(rng.integers(count))
        mesh, width, depth = maker(index)
        middle = s + 0.5 * width
        t = side * (front_m + 0.5 * depth + float(rng.uniform(0.0, 0.8 if library == "block" else 3.0)))
        crossed = any(
            abs(middle - centre) < planter.street.junction_half_m + 0.5 * width + 1.0
            for centre in planter.street.junction_s_m
        )
        if not crossed:
            planter.put(
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


def plant_border(planter: Planter, side: float, t_m: float, *, fence_kind: int | None = None) -> None:
    rng = planter.rng
    hedge = fence_kind is None and rng.random() < 0.5
    index = int(rng.integers(plants.HEDGE_COUNT if hedge else 3))
    step = plants.HEDGE_LENGTH_M if hedge else furniture.FENCE_LENGTH_M
    for s in np.arange(planter.span_s_m[0], planter.span_s_m[1] - step, step):
        if (rng.random() < 0.15 and fence_kind is None) or planter.near_junction(float(s), step):
            continue
        if hedge:
            name, mesh = f"hedge/{index}", plants.hedge(index)
        else:
            number = index if fence_kind is None else fence_kind
            name, mesh = f"fence/{number}", furniture.fence(number)
        planter.put(name, mesh, s=float(s), t=side * t_m, turn_rad=0.5 * np.pi, size_wd=(step, 0.7))


def plant_background(planter: Planter) -> None:
    """Woods and houses at the end of the view, so that the horizon is rarely bare."""
    rng = planter.rng
    end = planter.span_s_m[1]
    for t in np.arange(-150.0, 151.0, 37.0):
        if rng.random() < 0.85:
            index = int(rng.integers(3))
            away = float(rng.uniform(15.0, 45.0))
            if abs(t) > 14.0 or rng.random() < 0.6:
                planter.put(
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
        for s in np.arange(max(planter.span_s_m[0], 10.0), end + 20.0, 37.0):
            if rng.random() < 0.6:
                index = int(rng.integers(3))
                planter.put(
                    f"tree_line/{index}",
                    plants.tree_line(index),
                    s=float(s),
                    t=side * float(rng.uniform(48.0, 90.0)),
                    turn_rad=0.5 * np.pi,
                    size_wd=(40.0, 5.0),
                    scale=float(rng.uniform(0.8, 1.3)),
                )
