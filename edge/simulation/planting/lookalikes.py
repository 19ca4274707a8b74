"""Puts things of a person's size beside the road, where people walk: they carry no label."""

from __future__ import annotations

import numpy as np

from edge.simulation.planting.planter import Planter
from edge.simulation.scenery.furniture import parked_bicycle
from edge.simulation.scenery.lookalikes import VARIANTS, lookalike, lookalike_base_wd

NEAR_M = 36.0  # a detector mistakes them for people up to here
_NEAR_PER_M, _FAR_PER_M = 0.14, 0.03  # on either side of a street that has an average share of them
_BUSY = (0.25, 1.0, 2.2)  # few, some, many
_BUSY_SHARES = (0.35, 0.4, 0.25)
_TOWN = {
    "street_tree": 0.22, "signs_on_pole": 0.16, "bin_on_post": 0.1, "machine": 0.11, "pillar": 0.06, "barrier": 0.07,
    "slim_shrub": 0.07, "cloth_column": 0.04, "board": 0.06, "hydrant": 0.06, "bicycle": 0.05,
}  # fmt: skip
_COUNTRY = {"street_tree": 0.45, "signs_on_pole": 0.25, "barrier": 0.1, "slim_shrub": 0.1, "pillar": 0.1}
_BICYCLES = 6


def plant_lookalikes(planter: Planter, side: float, kind: str) -> None:
    """Lookalikes along one side of the street, dense near the origin, alone or in short rows.

    Args:
        planter: puts them where they hide no labelled object.
        side: 1 right, -1 left.
        kind: city, residential, road, forest, park or campus.
    """
    rng = planter.rng
    shares = _COUNTRY if kind in ("forest", "road") else _TOWN
    busy = float(rng.choice(_BUSY, p=_BUSY_SHARES))
    last = planter.span_s_m[1]
    whole_way = last > 200.0  # a drive passes all of it
    for low, high, per_m in ((3.0, NEAR_M, _NEAR_PER_M), (NEAR_M, last, _NEAR_PER_M if whole_way else _FAR_PER_M)):
        for _ in range(int(rng.poisson(max(high - low, 0.0) * per_m * busy))):
            name = str(rng.choice(list(shares), p=list(shares.values())))
            index = int(rng.integers(VARIANTS))
            s, t = float(rng.uniform(low, high)), side * _beside(planter, side, kind)
            count = int(rng.integers(2, 5)) if rng.random() < 0.2 else 1
            spacing = float(rng.uniform(0.9, 3.0))
            turn = float(rng.choice([0.0, np.pi, -0.5 * side * np.pi])) + float(rng.normal(0.0, 0.25))
            for place in range(count):
                _put(planter, name, index, place=(s + spacing * place, t), turn_rad=turn)


def _beside(planter: Planter, side: float, kind: str) -> float:
    """Distance from the ego lane's middle: at the kerb, at the back of the pavement, or beyond it."""
    rng, street = planter.rng, planter.street
    edge = abs(planter.side_edge(side))
    back = edge + street.verge_m + street.pavement_m
    where = rng.random()
    if where < 0.45 or (kind == "city" and where > 0.8):
        return edge + float(rng.uniform(0.3, 1.0))
    if where < 0.8 and street.pavement_m > 0.0:
        return back - float(rng.uniform(0.2, 0.8))
    return back + float(rng.uniform(0.3, 5.0))


def _put(planter: Planter, name: str, index: int, *, place: tuple[float, float], turn_rad: float) -> None:
    if planter.near_junction(place[0], 0.5):
        return
    if name == "bicycle":
        mesh, base, index = parked_bicycle(index % _BICYCLES), (1.8, 0.5), index % _BICYCLES
    else:
        mesh, base = lookalike(name, index), lookalike_base_wd(name, index)
    scale = 1.0 if name == "bicycle" else float(planter.rng.uniform(0.88, 1.15))
    s, t = place
    planter.put(
        f"{name}/{index}", mesh, s=s, t=t, turn_rad=turn_rad, size_wd=base, room_m=0.7, scale=scale, whole_view=True
    )
