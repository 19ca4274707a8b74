"""The ground: carriageway, kerbs, verges, pavements, junctions, far land, markings, mended patches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.simulation.road import Road, Street
from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import Rgb, join, quads_mesh, surface_grid

FloatArray = NDArray[np.float64]
_FAR_M = 160.0
_JUNCTION_REACH_M = 55.0
_MARKING_LIFT_M = 0.012
_PAINT_WHITE: Rgb = (0.62, 0.62, 0.60)


@dataclass(frozen=True, slots=True)
class GroundLook:
    """Colours and kinds of the ground's parts.

    Attributes:
        asphalt: colour of the carriageway; parking: of parked rows.
        pavement_material, pavement: of the pavement.
        land_left, land_right: (material, colour) beyond the pavement.
    """

    asphalt: Rgb
    parking: Rgb
    pavement_material: Material
    pavement: Rgb
    land_left: tuple[Material, Rgb]
    land_right: tuple[Material, Rgb]

    @staticmethod
    def draw(rng: np.random.Generator, street: Street) -> GroundLook:
        """A random look that suits the street."""
        tone = float(rng.uniform(0.075, 0.17))
        asphalt = (tone, tone * 0.99, tone * 0.965)
        green = (float(rng.uniform(0.045, 0.10)), float(rng.uniform(0.075, 0.125)), float(rng.uniform(0.015, 0.035)))
        dry = (0.22, 0.19, 0.10)
        lands: list[tuple[Material, Rgb]] = []
        for _ in range(2):
            if (street.kind == "campus" and rng.random() < 0.7) or (street.kind == "city" and rng.random() < 0.6):
                grey = float(rng.uniform(0.17, 0.3))
                lands.append((Material.CONCRETE, (grey, grey * 0.97, grey * 0.92)))
            else:
                lands.append((Material.GRASS, dry if rng.random() < 0.15 else green))
        grey = float(rng.uniform(0.17, 0.32))
        brick = rng.random() < 0.25
        pavement = (0.26, 0.15, 0.11) if brick else (grey, grey * 0.98, grey * 0.94)
        cobble = rng.random() < 0.3
        parking = (0.16, 0.15, 0.14) if cobble else asphalt
        return GroundLook(asphalt, parking, Material.CONCRETE, pavement, lands[0], lands[1])


@dataclass(frozen=True, slots=True)
class _Band:
    """A strip of the cross-section from t0 to t1, raised at both ends."""

    t0: float
    t1: float
    raised0: float
    raised1: float
    material: Material
    colour: Rgb


def _bands(street: Street, look: GroundLook) -> list[_Band]:
    kerb_colour: Rgb = (0.30, 0.29, 0.28)
    asphalt = Material.ASPHALT
    bands: list[_Band] = []
    left_lane, right_lane = street.left_edge_m, street.right_edge_m
    if street.parking_left:
        left_lane += street.parking_m
        bands.append(_Band(street.left_edge_m, left_lane, 0.0, 0.0, asphalt, look.parking))
    bands.append(
        _Band(
            left_lane, right_lane - (street.parking_m if street.parking_right else 0.0), 0.0, 0.0, asphalt, look.asphalt
        )
    )
    if street.parking_right:
        bands.append(_Band(right_lane - street.parking_m, right_lane, 0.0, 0.0, asphalt, look.parking))
    kerb = street.kerb_m
    for sign, edge, land in ((1.0, street.right_edge_m, look.land_right), (-1.0, street.left_edge_m, look.land_left)):
        side: list[tuple[float, float, float, float, Material, Rgb]] = []
        reach = 0.0
        if kerb > 0.0:
            side.append((0.0, 0.001, 0.0, kerb, Material.CONCRETE, kerb_colour))
            side.append((0.001, 0.14, kerb, kerb, Material.CONCRETE, kerb_colour))
            reach = 0.14
        if street.verge_m > 0.0:
            verge = land[1] if land[0] == Material.GRASS else (0.06, 0.095, 0.02)
            side.append((reach, reach + street.verge_m, kerb, kerb, Material.GRASS, verge))
            reach += street.verge_m
        if street.pavement_m > 0.0:
            side.append((reach, reach + street.pavement_m, kerb, kerb, look.pavement_material, look.pavement))
            reach += street.pavement_m
        for start, end in ((reach, reach + 12.0), (reach + 12.0, reach + 40.0), (reach + 40.0, _FAR_M)):
            side.append((start, end, kerb, kerb, land[0], land[1]))
        for start, end, low, high, material, colour in side:
            if sign > 0:
                bands.append(_Band(edge + start, edge + end, low, high, material, colour))
            else:
                bands.insert(0, _Band(edge - end, edge - start, high, low, material, colour))
    return bands


def ground_mesh(road: Road, street: Street, look: GroundLook, *, from_s_m: float, to_s_m: float) -> Mesh:
    """Ground and markings between two stations."""
    rows = _stations(street, from_s_m, to_s_m)
    bands = _bands(street, look)
    t = np.array([bands[0].t0] + [band.t1 for band in bands])
    raised = np.array([bands[0].raised0] + [band.raised1 for band in bands])
    in_junction_row = _in_junction(street, rows)
    raise_rc = np.where(in_junction_row[:, None] & (np.abs(t) < _JUNCTION_REACH_M)[None, :], 0.0, raised[None, :])
    x, z = road.to_world(rows[:, None], t[None, :])
    y = np.broadcast_to(road.height_at(rows)[:, None], x.shape) - raise_rc
    points = np.stack([x, y, z], axis=-1)
    middle = 0.5 * (rows[1:] + rows[:-1])
    materials = np.broadcast_to(
        np.array([band.material for band in bands], dtype=np.uint8), (len(middle), len(bands))
    ).copy()
    colours = np.broadcast_to(
        np.array([band.colour for band in bands], dtype=np.float32), (len(middle), len(bands), 3)
    ).copy()
    near = np.array([abs(0.5 * (band.t0 + band.t1)) < _JUNCTION_REACH_M for band in bands])
    crossing = _in_junction(street, middle)[:, None] & near[None, :]
    materials[crossing] = Material.ASPHALT
    colours[crossing] = look.asphalt
    sheet = surface_grid(points, materials=materials, colours=colours, smooth=False)
    if sheet.normals[:, 1].mean() > 0:
        sheet = surface_grid(points, materials=materials, colours=colours, smooth=False, flip=True)
    return sheet


def _stations(street: Street, from_s_m: float, to_s_m: float) -> FloatArray:
    rows = np.arange(from_s_m, to_s_m + 1.0, 3.0)
    cuts = [
        centre + side * street.junction_half_m + nudge
        for centre in street.junction_s_m
        for side in (-1, 1)
        for nudge in (-0.1, 0.1)
    ]
    return np.unique(np.concatenate([rows, np.array(cuts)]))


def _in_junction(street: Street, s: FloatArray) -> NDArray[np.bool_]:
    inside = np.zeros(len(s), dtype=bool)
    for centre in street.junction_s_m:
        inside |= np.abs(s - centre) < street.junction_half_m
    return inside


class _Strips:
    """Quads laid on the road."""

    def __init__(self, road: Road) -> None:
        self._road = road
        self.corners: list[FloatArray] = []
        self.colours: list[Rgb] = []
        self.materials: list[Material] = []

    def add(
        self,
        s: tuple[float, float],
        t: tuple[float, float],
        *,
        colour: Rgb,
        material: Material = Material.MARKING,
        lift_m: float = _MARKING_LIFT_M,
    ) -> None:
        """A patch between two stations and two offsets, cut every few metres to follow the road."""
        cuts = np.linspace(s[0], s[1], max(2, int(np.ceil((s[1] - s[0]) / 3.0)) + 1))
        x, z = self._road.to_world(cuts[:, None], np.array(t)[None, :])
        y = np.broadcast_to(self._road.height_at(cuts)[:, None], x.shape) - lift_m
        points = np.stack([x, y, z], axis=-1)
        quads = np.stack([points[:-1, 0], points[:-1, 1], points[1:, 1], points[1:, 0]], axis=1)
        self.corners.append(quads)
        self.colours += [colour] * len(quads)
        self.materials += [material] * len(quads)

    def mesh(self) -> Mesh | None:
        """All strips as one mesh."""
        if not self.corners:
            return None
        corners = np.concatenate(self.corners)
        normals = np.tile([[0.0, -1.0, 0.0]], (len(corners), 1))
        return quads_mesh(corners, normals, material=np.array(self.materials), colour=np.array(self.colours))


def markings_mesh(
    road: Road, street: Street, look: GroundLook, rng: np.random.Generator, *, from_s_m: float, to_s_m: float
) -> Mesh | None:
    """Lane lines, edge lines, stop lines, zebras, mended patches and manhole covers."""
    strips = _Strips(road)
    gaps = [
        (centre - street.junction_half_m - 1.0, centre + street.junction_half_m + 1.0) for centre in street.junction_s_m
    ]

    def clear(start: float, end: float) -> bool:
        return all(end < low or start > high for low, high in gaps)

    for _ in range(int(rng.poisson((to_s_m - from_s_m) / 18.0))):
        s, t = (
            float(rng.uniform(from_s_m, to_s_m)),
            float(rng.uniform(street.left_edge_m + 1.5, street.right_edge_m - 1.5)),
        )
        length, width = float(rng.uniform(0.8, 9.0)), float(rng.uniform(0.5, 1.4))
        shade = float(rng.choice([0.6, 0.75, 1.25]))
        colour = (look.asphalt[0] * shade, look.asphalt[1] * shade, look.asphalt[2] * shade)
        strips.add((s, s + length), (t - width, t + width), colour=colour, material=Material.ASPHALT, lift_m=0.006)
    for _ in range(int(rng.poisson((to_s_m - from_s_m) / 30.0))):
        s, t = (
            float(rng.uniform(from_s_m, to_s_m)),
            float(rng.uniform(street.left_edge_m + 0.8, street.right_edge_m - 0.8)),
        )
        strips.add((s, s + 0.6), (t - 0.3, t + 0.3), colour=(0.05, 0.05, 0.052), material=Material.ASPHALT)
    if street.marked:
        _lines(strips, street, rng, span=(from_s_m, to_s_m), clear=clear)
    for low, high in gaps:
        if street.marked and rng.random() < 0.7:
            strips.add(
                (low - 0.5, low - 0.1),
                (-0.5 * street.lane_m, (street.lanes_right + 0.5) * street.lane_m),
                colour=_PAINT_WHITE,
            )
            strips.add(
                (high + 0.1, high + 0.5),
                (-(street.lanes_left + 0.5) * street.lane_m, -0.5 * street.lane_m),
                colour=_PAINT_WHITE,
            )
        if rng.random() < 0.3:
            for t in np.arange(street.left_edge_m + 0.4, street.right_edge_m - 0.4, 1.0):
                strips.add((high + 1.0, high + 4.0), (float(t), float(t) + 0.5), colour=_PAINT_WHITE)
    if rng.random() < 0.15 and street.kind in ("city", "campus", "residential"):
        s = float(rng.uniform(8.0, 45.0)) + from_s_m + 15.0
        for t in np.arange(street.left_edge_m + 0.4, street.right_edge_m - 0.4, 1.0):
            strips.add((s, s + 3.0), (float(t), float(t) + 0.5), colour=_PAINT_WHITE)
    return strips.mesh()


def _lines(strips: _Strips, street: Street, rng: np.random.Generator, *, span: tuple[float, float], clear) -> None:  # type: ignore[no-untyped-def]
    dash, period = (3.0, 9.0) if street.kind in ("city", "residential") else (4.0, 12.0)
    if rng.random() < 0.3:
        dash, period = 6.0, 9.0
    phase = float(rng.uniform(0.0, period))
    solid_centre = rng.random() < 0.2
    dashed = [-0.5 * street.lane_m - street.lane_m * index for index in range(1, street.lanes_left)]
    dashed += [0.5 * street.lane_m + street.lane_m * index for index in range(street.lanes_right)]
    strips_solid = [-0.5 * street.lane_m] if solid_centre else []
    if not solid_centre:
        dashed.append(-0.5 * street.lane_m)
    for start in np.arange(span[0] - phase, span[1], period):
        if clear(start, start + dash):
            for t in dashed:
                strips.add((start, start + dash), (t - 0.06, t + 0.06), colour=_PAINT_WHITE)
    edges = []
    if street.kind in ("road", "forest") or rng.random() < 0.3:
        edges = [(street.lanes_right + 0.5) * street.lane_m - 0.2, -(street.lanes_left + 0.5) * street.lane_m + 0.2]
    for t in strips_solid + edges:
        for start in np.arange(span[0], span[1], 6.0):
            if clear(start, start + 6.0):
                strips.add((start, start + 6.0), (t - 0.07, t + 0.07), colour=_PAINT_WHITE)
    if street.parking_right and rng.random() < 0.3:
        edge = street.right_edge_m
        for start in np.arange(span[0], span[1], 5.6):
            if clear(start, start + 1.0):
                strips.add((start, start + 0.12), (edge - street.parking_m, edge), colour=_PAINT_WHITE)


def pads_mesh(footprints: list[tuple[FloatArray, float]], colour: Rgb) -> Mesh | None:
    """Asphalt under vehicles that stand off the street: corners (4, 2) with the ground's y."""
    if not footprints:
        return None
    corners = np.array([[[x, y - 0.012, z] for x, z in quad] for quad, y in footprints])
    normals = np.tile([[0.0, -1.0, 0.0]], (len(corners), 1))
    return quads_mesh(corners, normals, material=Material.ASPHALT, colour=colour)


def joined(parts: list[Mesh | None]) -> Mesh:
    """The meshes that exist as one."""
    return join([part for part in parts if part is not None])
