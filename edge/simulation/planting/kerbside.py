"""Street furniture at the kerb and on the pavement."""

from __future__ import annotations

import numpy as np

from edge.simulation.planting.planter import Planter
from edge.simulation.scenery import furniture


def furnish(planter: Planter, side: float, kind: str) -> None:
    rng, street = planter.rng, planter.street
    edge = abs(planter.side_edge(side))
    across = 0.0 if side > 0 else np.pi
    if kind not in ("forest",) and rng.random() < 0.7:
        index = int(rng.integers(3))
        spacing = float(rng.uniform(22.0, 38.0))
        for s in np.arange(planter.span_s_m[0] + float(rng.uniform(0, spacing)), planter.span_s_m[1], spacing):
            planter.put(
                f"lamp/{index}",
                furniture.lamp_post(index),
                s=float(s),
                t=side * (edge + 0.6),
                turn_rad=across,
                size_wd=(0.3, 0.3),
            )
    if rng.random() < 0.12:
        for s in np.arange(planter.span_s_m[0] + float(rng.uniform(0, 30)), planter.span_s_m[1], 32.0):
            planter.put(
                "mast", furniture.mast(), s=float(s), t=side * (edge + 1.2), turn_rad=across, size_wd=(0.4, 0.4)
            )
    for _ in range(int(rng.poisson((planter.span_s_m[1] - planter.span_s_m[0]) / (45.0 if side > 0 else 90.0)))):
        index = int(rng.integers(furniture.SIGN_COUNT))
        s = float(rng.uniform(planter.span_s_m[0] + 5.0, planter.span_s_m[1]))
        turn = float(rng.normal(0.0, 0.15)) + (0.0 if side > 0 or rng.random() < 0.3 else np.pi)
        planter.put(
            f"sign/{index}",
            furniture.sign(index),
            s=s,
            t=side * (edge + float(rng.uniform(0.5, 1.2))),
            turn_rad=turn,
            size_wd=(0.3, 0.3),
        )
    if street.pavement_m > 0 and rng.random() < 0.3:
        index, spacing = int(rng.integers(2)), float(rng.uniform(1.6, 3.0))
        start = float(rng.uniform(planter.span_s_m[0], planter.span_s_m[1] - 30.0))
        for s in np.arange(start, start + float(rng.uniform(8.0, 40.0)), spacing):
            planter.put(
                f"bollard/{index}",
                furniture.bollard(index),
                s=float(s),
                t=side * (edge + 0.35),
                turn_rad=0.0,
                size_wd=(0.3, 0.3),
            )
    if street.pavement_m > 0:
        for _ in range(int(rng.poisson((planter.span_s_m[1] - planter.span_s_m[0]) / 50.0))):
            index = int(rng.integers(9))
            s = float(rng.uniform(planter.span_s_m[0], planter.span_s_m[1]))
            planter.put(
                f"bin/{index}",
                furniture.bin_or_box(index),
                s=s,
                t=side * (edge + street.verge_m + street.pavement_m - 0.4),
                turn_rad=-side * 0.5 * np.pi,
                size_wd=(1.6, 0.7),
            )
    if street.pavement_m > 0 and rng.random() < 0.12:
        s = float(rng.uniform(15.0, 60.0))
        planter.put(
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
            planter.put(
                "traffic_light",
                furniture.traffic_light(),
                s=s,
                t=side * (edge + 0.7),
                turn_rad=across,
                size_wd=(0.4, 0.4),
            )
    if kind == "city" and rng.random() < 0.35:
        park_bicycles(planter, side, edge + street.verge_m + 0.8)


def park_bicycles(planter: Planter, side: float, t_m: float) -> None:
    rng = planter.rng
    start = float(rng.uniform(planter.span_s_m[0] + 8.0, planter.span_s_m[0] + 60.0))
    for number in range(int(rng.integers(3, 12))):
        index = int(rng.integers(6))
        s = start + 0.65 * number + float(rng.normal(0, 0.06))
        planter.put(
            f"bicycle/{index}",
            furniture.parked_bicycle(index),
            s=s,
            t=side * (t_m + 0.6),
            turn_rad=float(rng.normal(0, 0.1)),
            size_wd=(1.8, 0.5),
        )
