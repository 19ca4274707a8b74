"""Streets and roads that suit what a frame should hold."""

from __future__ import annotations

import numpy as np

from edge.simulation.road import Road, Street, curve

ROAD_BEHIND_M, ROAD_AHEAD_M = 20, 170


def draw_street(rng: np.random.Generator, *, vehicles: int, people: int) -> Street:
    """A street that suits the number of vehicles and people."""
    if people >= 4:
        shares = {"city": 0.5, "campus": 0.4, "residential": 0.1}
    elif vehicles >= 6:
        shares = {"residential": 0.5, "city": 0.38, "road": 0.12}
    elif vehicles + people >= 3:
        shares = {"residential": 0.3, "city": 0.35, "road": 0.25, "forest": 0.1}
    else:
        shares = {"residential": 0.2, "city": 0.2, "road": 0.3, "forest": 0.2, "campus": 0.1}
    kind = str(rng.choice(list(shares), p=list(shares.values())))
    crowded = vehicles >= 5
    if kind == "residential":
        lane = float(rng.uniform(2.5, 3.1))
        return Street(
            kind,
            lane,
            parking_right=bool(rng.random() < 0.8),
            parking_left=bool(rng.random() < 0.8),
            marked=bool(rng.random() < 0.15),
            pavement_m=float(rng.uniform(1.5, 2.5)),
            verge_m=float(rng.choice([0.0, 0.0, 1.2])),
        )
    if kind == "city":
        return Street(
            kind,
            float(rng.uniform(2.9, 3.5)),
            lanes_right=int(rng.random() < 0.25),
            lanes_left=1 + int(rng.random() < 0.25),
            parking_right=bool(rng.random() < (0.75 if crowded else 0.4)),
            parking_left=bool(rng.random() < (0.75 if crowded else 0.4)),
            pavement_m=float(rng.uniform(2.0, 4.0)),
            verge_m=float(rng.choice([0.0, 0.0, 1.5, 2.5])),
            marked=bool(rng.random() < 0.7),
        )
    if kind == "campus":
        return Street(
            kind,
            float(rng.uniform(2.6, 3.2)),
            kerb_m=0.02,
            pavement_m=float(rng.uniform(3.0, 8.0)),
            marked=False,
            parking_right=bool(rng.random() < 0.25),
        )
    if kind == "forest":
        return Street(kind, float(rng.uniform(3.0, 3.6)), kerb_m=0.0, pavement_m=0.0, verge_m=3.0)
    return Street(
        kind,
        float(rng.uniform(3.2, 3.7)),
        lanes_right=int(rng.random() < 0.4),
        lanes_left=1 + int(rng.random() < 0.4),
        kerb_m=float(rng.choice([0.0, 0.1])),
        pavement_m=float(rng.choice([0.0, 2.0])),
        verge_m=float(rng.uniform(1.0, 4.0)),
        parking_right=bool(crowded and rng.random() < 0.5),
        parking_left=bool(crowded and rng.random() < 0.5),
    )


def draw_road(rng: np.random.Generator, street: Street) -> Road:
    """A straight or gently bent road through the ego car, rising or falling a little."""
    count = ROAD_BEHIND_M + ROAD_AHEAD_M + 1
    tightest = {"city": 1 / 400, "residential": 1 / 250, "campus": 1 / 200, "forest": 1 / 350, "road": 1 / 450}[
        street.kind
    ]
    bend = 0.0 if rng.random() < 0.45 else rng.normal(0.0, tightest)
    curvature = np.full(count, bend)
    curvature[ROAD_BEHIND_M + 25 :] += rng.normal(0.0, 0.5 * tightest)
    s = np.arange(-ROAD_BEHIND_M, ROAD_AHEAD_M + 1.0)
    slope, reach = rng.normal(0.0015, 0.012), 45.0
    height = slope * reach * (1.0 - np.exp(-np.maximum(s, -40.0) / reach)) * np.where(s > 0, 1.0, 0.5)
    return curve(
        curvature_per_m=curvature,
        first_s_m=-float(ROAD_BEHIND_M),
        heading_at_zero_rad=float(rng.normal(0.0, 0.02)),
        offset_at_zero_m=float(rng.normal(0.0, 0.2)),
        height_m=height,
    )
