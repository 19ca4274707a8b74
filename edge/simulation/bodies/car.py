"""Cars and vans: a lofted body shell with glass, lamps, plates, wheels and mirrors.

A shell is a row of cross-sections along the length. Each section's right half is nine points from the sill over the
waist and the window to the roof's middle; where the roof line is no higher than the waist (bonnet, boot), the window
part shrinks to nothing. Heights are shares of the body height, stations shares of the length from the nose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import box, disc, fitted, join, surface_grid

_PAINT = (1.0, 1.0, 1.0)
_TRIM = (0.025, 0.025, 0.028)
_GLASS = (0.03, 0.035, 0.04)
_HEADLAMP = (0.75, 0.78, 0.8)
_TAIL_LAMP = (0.36, 0.012, 0.012)
_PLATE = (0.75, 0.75, 0.72)
_RIM = (0.42, 0.43, 0.45)
_RIM_GAP = (0.07, 0.07, 0.075)
_TYRE = (0.022, 0.022, 0.024)


@dataclass(frozen=True, slots=True)
class CarShape:
    """The lines of one body.

    Attributes:
        size_hwl: nominal size, metres.
        roof_line: (station, height share) pairs from nose to tail.
        cowl, screen_top, roof_end, window_end: stations where the windscreen starts and ends and the rear window
            starts and ends.
        waist: height share of the window's lower edge at the cowl and at the tail.
        roof_width: half width of the roof edge as a share of the half width at the waist.
        wheel_radius_m: tyre radius.
        wheel_stations: of front and rear axle.
        side_glass: stations between which the side has windows.
        trim_sills: lower body in dark plastic.
    """

    size_hwl: tuple[float, float, float]
    roof_line: tuple[tuple[float, float], ...]
    cowl: float
    screen_top: float
    roof_end: float
    window_end: float
    waist: tuple[float, float] = (0.60, 0.64)
    roof_width: float = 0.76
    wheel_radius_m: float = 0.31
    wheel_stations: tuple[float, float] = (0.19, 0.80)
    side_glass: tuple[float, float] = (0.36, 0.88)
    trim_sills: bool = False
    rear_glass: bool = True
    pillar: float = 0.56


def build_car(shape: CarShape) -> Mesh:
    """The mesh of a car in its model frame (front at +x), extent exactly ``shape.size_hwl``."""
    height, width, length = shape.size_hwl
    parts = [_shell(shape), _end_face(shape, front=True), _end_face(shape, front=False)]
    parts += _wheels(shape)
    waist_y = -shape.waist[0] * height
    for side in (-1.0, 1.0):
        x = length * (0.5 - shape.cowl - 0.07)
        parts.append(
            box(
                (x - 0.07, waist_y - 0.13, side * 0.455 * width),
                (x + 0.07, waist_y + 0.01, side * 0.5 * width),
                material=Material.CAR_PAINT,
                colour=_PAINT,
            )
        )
    return fitted(join(parts), shape.size_hwl)


def _roof(shape: CarShape, station: NDArray[np.float64]) -> NDArray[np.float64]:
    knots = np.array(shape.roof_line)
    return np.interp(station, knots[:, 0], knots[:, 1])


def _plan_width(station: NDArray[np.float64]) -> NDArray[np.float64]:
    """Half width along the length, as a share: rounded nose and tail."""
    return np.interp(
        station,
        [0.0, 0.012, 0.035, 0.08, 0.16, 0.86, 0.95, 0.985, 1.0],
        [0.78, 0.86, 0.915, 0.955, 0.985, 0.985, 0.95, 0.91, 0.84],
    )


def _section(shape: CarShape, station: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Right half sections: heights (S, 9), shares of the body height; half widths (S, 9), shares of half the width."""
    roof = _roof(shape, station)
    waist = np.minimum(np.interp(station, [shape.cowl, 1.0], shape.waist), roof - 0.045)
    cabin = np.clip((roof - waist - 0.045) / (0.93 - waist), 0.0, 1.0)
    plan = _plan_width(station)
    sill = np.full_like(station, 0.13)
    heights = np.stack(
        [
            sill,
            np.full_like(station, 0.20),
            np.minimum(0.40, waist - 0.06),
            np.minimum(0.50, waist - 0.03),
            waist,
            waist + 0.02,
            waist + 0.84 * (roof - waist),
            waist + 0.97 * (roof - waist),
            roof,
        ],
        axis=1,
    )
    upper = shape.roof_width
    widths = np.stack(
        [
            plan * 0.90,
            plan * 0.965,
            plan * 0.985,
            plan * 0.98,
            plan * 0.95,
            plan * (0.93 - 0.01 * cabin),
            plan * (0.88 + (upper - 0.88) * cabin),
            plan * (0.80 + (upper - 0.09 - 0.80) * cabin),
            np.zeros_like(station),
        ],
        axis=1,
    )
    return heights, widths


def _overhang_m(height_share: NDArray[np.float64], *, front: bool) -> NDArray[np.float64]:
    """How far the nose or tail lies back from the bumper at each height, metres."""
    depth = (0.05, 0.0, 0.0, 0.05, 0.10, 0.16) if front else (0.06, 0.0, 0.0, 0.03, 0.05, 0.08)
    return np.interp(height_share, [0.13, 0.22, 0.34, 0.45, 0.55, 0.7], depth)


def _shell(shape: CarShape) -> Mesh:
    height, width, length = shape.size_hwl
    axles = [value for centre in shape.wheel_stations for value in (centre - 0.075, centre, centre + 0.075)]
    glass_from, glass_to = shape.side_glass
    knots = [0.0, 0.012, 0.035, 0.08, shape.cowl, 0.5 * (shape.cowl + shape.screen_top), shape.screen_top, glass_from]
    knots += [shape.pillar - 0.014, shape.pillar + 0.014, glass_to, shape.roof_end, shape.window_end, 0.95, 0.985, 1.0]
    knots += [knot[0] for knot in shape.roof_line] + axles
    station = np.unique(np.round(np.clip(knots, 0.0, 1.0), 4))
    station = station[np.concatenate([[True], np.diff(station) > 0.004])]
    station[-1] = 1.0
    heights, widths = _section(shape, station)
    x = length * (0.5 - station)[:, None] * np.ones_like(heights)
    x -= _overhang_m(heights, front=True) * np.exp(-station / 0.05)[:, None]
    x += _overhang_m(heights, front=False) * np.exp(-(1.0 - station) / 0.05)[:, None]
    right = np.stack([x, -heights * height, 0.5 * width * widths], axis=-1)
    left = right[:, ::-1][:, 1:] * np.array([1.0, 1.0, -1.0])
    points = np.concatenate([right, left], axis=1)  # sill right .. roof middle .. sill left: 17 points

    middle = 0.5 * (station[1:] + station[:-1])
    cells = points.shape[1] - 1
    material = np.full((len(middle), cells), Material.CAR_PAINT, dtype=np.uint8)
    colour = np.ones((len(middle), cells, 3), dtype=np.float32) * np.array(_PAINT, dtype=np.float32)

    def paint(rows: NDArray[np.bool_], bands: tuple[int, ...], kind: Material, rgb: tuple[float, float, float]) -> None:
        for band in bands:
            for index in (band, cells - 1 - band):
                material[rows, index] = kind
                colour[rows, index] = rgb

    screen = (middle > shape.cowl) & (middle < shape.screen_top)
    paint(screen, (7,), Material.GLASS, _GLASS)
    if shape.rear_glass:
        paint((middle > shape.roof_end) & (middle < shape.window_end), (7,), Material.GLASS, _GLASS)
    paint((middle > glass_from) & (middle < glass_to), (5,), Material.GLASS, _GLASS)
    half_screen = (middle > 0.5 * (shape.cowl + shape.screen_top)) & (middle < glass_from)
    paint(half_screen, (5,), Material.GLASS, _GLASS)
    paint((middle > shape.pillar - 0.014) & (middle < shape.pillar + 0.014), (5,), Material.MATTE, _TRIM)
    paint(middle >= 0.0, (0,), Material.MATTE, _TRIM)
    if shape.trim_sills:
        paint((middle > 0.08) & (middle < 0.95), (1,), Material.MATTE, (0.05, 0.05, 0.052))
    paint(middle < 0.055, (3,), Material.LAMP, _HEADLAMP)
    paint(middle > 0.965, (3,), Material.LAMP, _TAIL_LAMP)
    shell = surface_grid(points, materials=material, colours=colour, flip=True)
    floor = np.stack([points[:, 0], points[:, -1]], axis=1)
    under = surface_grid(floor, materials=Material.MATTE, colours=(0.012, 0.012, 0.012), flip=False, smooth=False)
    return join([shell, under])


def _end_face(shape: CarShape, *, front: bool) -> Mesh:
    """Nose or tail: a sheet of cells between the sections' outermost points, with lamps, grille, plate and bumper."""
    height, width, length = shape.size_hwl
    station = np.array([0.0 if front else 1.0])
    heights, widths = _section(shape, station)
    top = float(heights[0, -1])
    inner = [0.165, 0.24, 0.275, 0.335, 0.385, 0.43, 0.52, 0.60, 0.70]
    rows = np.array([0.13] + [value for value in inner if value < top - 0.02] + [top])
    half = np.interp(rows, heights[0, :-1], widths[0, :-1]) * 0.5 * width
    columns = np.array([-1.0, -0.88, -0.62, -0.48, -0.30, -0.15, 0.15, 0.30, 0.48, 0.62, 0.88, 1.0])
    x = 0.5 * length - _overhang_m(rows, front=front)
    bulge = 0.03 * (1.0 - columns**2)
    points = np.stack(
        [
            (x[:, None] + bulge[None, :]) * (1.0 if front else -1.0),
            np.broadcast_to(-rows[:, None] * height, (len(rows), len(columns))),
            half[:, None] * columns[None, :],
        ],
        axis=-1,
    )
    row = (0.5 * (rows[1:] + rows[:-1]))[:, None]
    column = np.abs(0.5 * (columns[1:] + columns[:-1]))[None, :]
    shape_rc = (len(rows) - 1, len(columns) - 1)
    material = np.full(shape_rc, Material.CAR_PAINT, dtype=np.uint8)
    colour = np.ones((*shape_rc, 3), dtype=np.float32) * np.array(_PAINT, dtype=np.float32)

    def paint(where: NDArray[np.bool_], kind: Material, rgb: tuple[float, float, float]) -> None:
        cells = np.broadcast_to(where, shape_rc)
        material[cells] = kind
        colour[cells] = rgb

    paint((row < 0.165) & (column < 2), Material.MATTE, _TRIM)
    if front:
        paint((row > 0.165) & (row < 0.24) & (column < 0.62), Material.MATTE, _TRIM)
        paint((row > 0.385) & (row < 0.47) & (column < 0.48), Material.MATTE, (0.03, 0.03, 0.032))
        paint((row > 0.385) & (row < 0.52) & (column > 0.62), Material.LAMP, _HEADLAMP)
        paint((row > 0.275) & (row < 0.335) & (column < 0.30), Material.SIGN, _PLATE)
    else:
        lamp_low, lamp_high = (0.43, 0.60) if top > 0.62 else (0.43, 0.52)
        paint((row > lamp_low) & (row < lamp_high) & (column > 0.62), Material.LAMP, _TAIL_LAMP)
        plate_low, plate_high = (0.43, 0.52) if top > 0.62 else (0.385, 0.43)
        paint((row > plate_low) & (row < plate_high) & (column < 0.30), Material.SIGN, _PLATE)
        if shape.trim_sills:
            paint((row < 0.275) & (column < 2), Material.MATTE, (0.05, 0.05, 0.052))
    return surface_grid(points, materials=material, colours=colour, flip=not front)


def _wheels(shape: CarShape) -> list[Mesh]:
    _, width, length = shape.size_hwl
    radius = shape.wheel_radius_m
    parts = []
    for station in shape.wheel_stations:
        x = length * (0.5 - station)
        for side in (-1.0, 1.0):
            outer = side * 0.49 * width
            parts += wheel(x, radius=radius, outer_z_m=outer, thickness_m=0.2 * side)
            arch = disc(
                (x, -radius, side * 0.4885 * width),
                axis=2, radius=1.16 * radius, inner=0.9 * radius, sign=side,
                material=Material.MATTE, colour=(0.012, 0.012, 0.012), sides=10, arc=(np.pi, 2.0 * np.pi),
            )  # fmt: skip
            parts.append(arch)
    return parts


def wheel(x_m: float, *, radius: float, outer_z_m: float, thickness_m: float) -> list[Mesh]:
    """Tyre tread, side wall and rim of a wheel standing on y = 0; ``thickness_m`` is signed like the outer side."""
    sides = 16
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    rim = np.stack([x_m + radius * np.cos(angle), -radius + radius * np.sin(angle)], axis=-1)
    tread = np.zeros((2, sides + 1, 3))
    tread[:, :, :2] = rim
    tread[0, :, 2] = outer_z_m
    tread[1, :, 2] = outer_z_m - thickness_m
    side = float(np.sign(thickness_m))
    centre = (x_m, -radius, outer_z_m)
    hub = (x_m, -radius, outer_z_m + 0.002 * side)
    spokes = np.where(np.arange(14)[:, None] % 2 == 0, _RIM, _RIM_GAP)
    return [
        surface_grid(tread, materials=Material.RUBBER, colours=_TYRE, flip=side < 0),
        disc(centre, axis=2, radius=radius, inner=0.0, sign=side, material=Material.RUBBER, colour=_TYRE, sides=sides),
        disc(hub, axis=2, radius=0.68 * radius, sign=side, material=Material.METAL, colour=spokes, sides=14),
    ]
