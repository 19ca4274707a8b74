"""Families of passenger cars and vans, and random members of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge.simulation.bodies.car import CarShape

_HATCH = CarShape(
    size_hwl=(1.47, 1.65, 3.95),
    roof_line=(
        (0.0, 0.51), (0.06, 0.565), (0.26, 0.665), (0.46, 0.965), (0.56, 1.0),
        (0.72, 0.985), (0.88, 0.92), (0.975, 0.66), (1.0, 0.60),
    ),
    cowl=0.26, screen_top=0.46, roof_end=0.88, window_end=0.975, side_glass=(0.38, 0.89),
)  # fmt: skip
_SEDAN = CarShape(
    size_hwl=(1.44, 1.68, 4.4),
    roof_line=(
        (0.0, 0.49), (0.06, 0.55), (0.29, 0.655), (0.45, 0.96), (0.54, 1.0),
        (0.66, 0.975), (0.72, 0.93), (0.86, 0.695), (0.97, 0.675), (1.0, 0.60),
    ),
    cowl=0.29, screen_top=0.45, roof_end=0.72, window_end=0.86, side_glass=(0.385, 0.77), pillar=0.55,
)  # fmt: skip
_ESTATE = CarShape(
    size_hwl=(1.48, 1.68, 4.45),
    roof_line=(
        (0.0, 0.49), (0.06, 0.55), (0.28, 0.65), (0.44, 0.96), (0.54, 1.0),
        (0.75, 0.99), (0.92, 0.93), (0.985, 0.66), (1.0, 0.58),
    ),
    cowl=0.28, screen_top=0.44, roof_end=0.92, window_end=0.985, side_glass=(0.375, 0.93), pillar=0.54,
)  # fmt: skip
_SUV = CarShape(
    size_hwl=(1.72, 1.75, 4.35),
    roof_line=(
        (0.0, 0.53), (0.05, 0.585), (0.25, 0.67), (0.41, 0.965), (0.52, 1.0),
        (0.75, 0.995), (0.92, 0.95), (0.975, 0.67), (1.0, 0.58),
    ),
    cowl=0.25, screen_top=0.41, roof_end=0.92, window_end=0.975, waist=(0.61, 0.65), wheel_radius_m=0.36,
    side_glass=(0.35, 0.92), trim_sills=True, pillar=0.55,
)  # fmt: skip
_SMALL = CarShape(
    size_hwl=(1.48, 1.58, 3.45),
    roof_line=(
        (0.0, 0.50), (0.05, 0.565), (0.21, 0.655), (0.42, 0.965), (0.55, 1.0),
        (0.75, 0.985), (0.90, 0.93), (0.98, 0.64), (1.0, 0.58),
    ),
    cowl=0.21, screen_top=0.42, roof_end=0.90, window_end=0.98, wheel_stations=(0.18, 0.83), wheel_radius_m=0.29,
    side_glass=(0.35, 0.91), pillar=0.60,
)  # fmt: skip
_MINIVAN = CarShape(
    size_hwl=(1.66, 1.74, 4.35),
    roof_line=(
        (0.0, 0.47), (0.05, 0.53), (0.20, 0.62), (0.42, 0.96), (0.54, 1.0),
        (0.78, 0.99), (0.93, 0.94), (0.985, 0.64), (1.0, 0.56),
    ),
    cowl=0.20, screen_top=0.42, roof_end=0.93, window_end=0.985, waist=(0.57, 0.62),
    side_glass=(0.34, 0.93), pillar=0.56,
)  # fmt: skip
_COUPE = CarShape(
    size_hwl=(1.36, 1.70, 4.25),
    roof_line=(
        (0.0, 0.50), (0.06, 0.57), (0.32, 0.68), (0.49, 0.96), (0.57, 1.0),
        (0.68, 0.97), (0.86, 0.74), (0.97, 0.70), (1.0, 0.62),
    ),
    cowl=0.32, screen_top=0.49, roof_end=0.68, window_end=0.86, waist=(0.63, 0.69),
    side_glass=(0.42, 0.74), pillar=0.66,
)  # fmt: skip
CAR_FAMILIES = (_HATCH, _SEDAN, _ESTATE, _SUV, _SMALL, _MINIVAN, _COUPE)
CAR_FAMILY_SHARES = (0.30, 0.22, 0.18, 0.07, 0.11, 0.09, 0.03)

_TRANSPORTER = CarShape(
    size_hwl=(1.97, 1.90, 4.85),
    roof_line=(
        (0.0, 0.42), (0.03, 0.49), (0.13, 0.565), (0.27, 0.95), (0.36, 0.99),
        (0.6, 1.0), (0.955, 0.985), (0.992, 0.70), (1.0, 0.55),
    ),
    cowl=0.13, screen_top=0.27, roof_end=0.955, window_end=0.992, waist=(0.55, 0.56), roof_width=0.85,
    wheel_radius_m=0.34, wheel_stations=(0.19, 0.79), side_glass=(0.25, 0.94), pillar=0.43,
)  # fmt: skip
_PANEL = replace(_TRANSPORTER, side_glass=(0.25, 0.43), pillar=0.432, rear_glass=False)
_HIGH_PANEL = CarShape(
    size_hwl=(2.55, 1.98, 5.7),
    roof_line=(
        (0.0, 0.34), (0.03, 0.40), (0.13, 0.455), (0.25, 0.78), (0.32, 0.93),
        (0.42, 0.99), (0.6, 1.0), (0.975, 0.985), (0.99, 0.6), (1.0, 0.45),
    ),
    cowl=0.13, screen_top=0.25, roof_end=0.975, window_end=0.99, waist=(0.46, 0.47), roof_width=0.88,
    wheel_radius_m=0.35, wheel_stations=(0.17, 0.78), side_glass=(0.23, 0.36), pillar=0.365, rear_glass=False,
)  # fmt: skip
_DELIVERY = CarShape(
    size_hwl=(1.85, 1.72, 4.2),
    roof_line=(
        (0.0, 0.46), (0.05, 0.54), (0.20, 0.62), (0.36, 0.93), (0.46, 0.99),
        (0.65, 1.0), (0.965, 0.975), (0.99, 0.68), (1.0, 0.56),
    ),
    cowl=0.20, screen_top=0.36, roof_end=0.965, window_end=0.99, waist=(0.57, 0.58), roof_width=0.82,
    wheel_radius_m=0.31, wheel_stations=(0.19, 0.81), side_glass=(0.32, 0.54), pillar=0.545, rear_glass=False,
)  # fmt: skip
VAN_FAMILIES = (_TRANSPORTER, _PANEL, _HIGH_PANEL, _DELIVERY)
VAN_FAMILY_SHARES = (0.32, 0.23, 0.25, 0.20)


def vary(shape: CarShape, rng: np.random.Generator) -> CarShape:
    """A random member of a family: roof line, waist, widths, axles and size shifted a little."""
    height, width, length = shape.size_hwl
    lift = rng.normal(0.0, 0.012)
    lean = rng.normal(0.0, 0.012)
    knots = []
    for station, share in shape.roof_line:
        cabin = shape.cowl < station < shape.window_end
        moved = station + (lean if cabin and 0.0 < station < 0.97 else 0.0)
        knots.append((moved, share + (lift if share < 0.75 else 0.0)))
    return replace(
        shape,
        size_hwl=(height * rng.normal(1.0, 0.02), width * rng.normal(1.0, 0.02), length * rng.normal(1.0, 0.04)),
        roof_line=tuple(knots),
        cowl=shape.cowl + 0.5 * lean,
        screen_top=shape.screen_top + lean,
        roof_end=shape.roof_end + (lean if shape.roof_end < 0.95 else 0.0),
        waist=(shape.waist[0] + lift, shape.waist[1] + lift + rng.normal(0.0, 0.01)),
        roof_width=shape.roof_width + rng.normal(0.0, 0.015),
        wheel_radius_m=shape.wheel_radius_m * rng.normal(1.0, 0.03),
        trim_sills=shape.trim_sills or bool(rng.random() < 0.2),
    )
