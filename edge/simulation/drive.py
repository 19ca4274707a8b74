"""Drives: one street, parked and moving traffic, an ego car that follows its lane; every moment from its time alone.

The label size of a walker or rider is constant along a drive: it holds every phase of the gait.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edge.simulation.bodies.library import Body
from edge.simulation.daylight import draw_light
from edge.simulation.frames import Moment, assemble, camera_pose
from edge.simulation.label_statistics import train_statistics
from edge.simulation.placing import PlacedObject, choose_body, draw_size, draw_tint
from edge.simulation.planting.planter import Surroundings
from edge.simulation.road import Road, Street, curve
from edge.simulation.scene import Light
from edge.simulation.streets import draw_street
from edge.simulation.surroundings import build_surroundings
from runtime.contracts.objects import wrap_angle_rad

FloatArray = NDArray[np.float64]
FRAMES_PER_SECOND = 10.0
_BEHIND_M, _AHEAD_M, _SEEN_AHEAD_M = 20.0, 190.0, 150.0
_STRIDE_M, _PEDAL_M = 1.45, 4.6
_EGO_SPEED_M_S = 8.0


@dataclass(frozen=True, slots=True)
class Mover:
    """An object of a drive in road coordinates: s = s0 + speed * time + sway of s; t constant, or crossing at a rate.

    Attributes:
        turn_rad: heading from the road's direction.
        cycle_m: way per gait cycle (0: no gait).
        weave_m, weave_rate: slow variation of s (a car ahead that comes and goes).
    """

    kind: str
    body: Body
    size_hwl: tuple[float, float, float]
    mesh_hwl: tuple[float, float, float]
    tint: tuple[float, float, float]
    s0_m: float
    t0_m: float
    speed_m_s: float
    turn_rad: float
    cycle_m: float = 0.0
    phase0: float = 0.0
    cross_m_s: float = 0.0
    weave_m: float = 0.0
    weave_rate: float = 0.0

    def at(self, time_secs: float) -> tuple[float, float, float]:
        """(s, t, way covered) at a time."""
        s = self.s0_m + self.speed_m_s * time_secs + self.weave_m * np.sin(self.weave_rate * time_secs + self.phase0)
        t = self.t0_m + self.cross_m_s * time_secs
        return float(s), float(t), float(abs(self.speed_m_s + self.cross_m_s) * time_secs)


@dataclass(frozen=True, slots=True)
class Drive:
    """The whole world of a drive."""

    seed: int
    road: Road
    street: Street
    surroundings: Surroundings
    light: Light
    movers: tuple[Mover, ...]
    speed_m_s: float
    camera_height_m: float
    duration_secs: float


def build_drive(seed: int, duration_secs: float) -> Drive:
    """The drive of a seed."""
    rng = np.random.default_rng([seed, 11])
    speed = float(rng.normal(_EGO_SPEED_M_S, 0.7))
    length_m = speed * duration_secs + _AHEAD_M
    street = _street(rng, length_m)
    road = _road(rng, length_m)
    movers = tuple(_traffic(rng, street, length_m=length_m, ego_speed_m_s=speed, duration_secs=duration_secs))
    surroundings = build_surroundings(
        road, street, rng, objects=(), span_s_m=(-8.0, length_m - 70.0), guard_views=False
    )
    return Drive(
        seed, road, street, surroundings, draw_light(rng), movers, speed, float(rng.normal(1.66, 0.03)), duration_secs
    )


def _street(rng: np.random.Generator, length_m: float) -> Street:
    street = draw_street(rng, vehicles=8, people=3)
    street = replace(
        street,
        parking_right=bool(rng.random() < 0.8),
        parking_left=bool(rng.random() < 0.8),
        pavement_m=max(street.pavement_m, 2.0),
    )
    if street.kind in ("city", "residential"):
        junctions = np.arange(float(rng.uniform(40.0, 110.0)), length_m, float(rng.uniform(80.0, 140.0)))
        street = replace(
            street, junction_s_m=tuple(float(s) for s in junctions), junction_half_m=float(rng.uniform(3.5, 5.5))
        )
    return street


def _road(rng: np.random.Generator, length_m: float) -> Road:
    s = np.arange(-_BEHIND_M, length_m + 61.0)
    waves = zip(rng.uniform(0.006, 0.018, 3), rng.uniform(0.0, 6.3, 3), rng.normal(0.0, 1 / 700, 3), strict=True)
    curvature = sum(size * np.sin(rate * s + phase) for rate, phase, size in waves)
    waves = zip(rng.uniform(0.02, 0.05, 2), rng.uniform(0.0, 6.3, 2), rng.normal(0.0, 0.12, 2), strict=True)
    height = sum(size * np.sin(rate * s + phase) for rate, phase, size in waves)
    return curve(
        curvature_per_m=np.asarray(curvature), first_s_m=-_BEHIND_M, heading_at_zero_rad=0.0, offset_at_zero_m=0.0,
        height_m=np.asarray(height - height[int(_BEHIND_M)]),
    )  # fmt: skip


def _mover(
    rng: np.random.Generator, kind: str, *, s: float, t: float, turn_rad: float, speed_m_s: float = 0.0, **more: float
) -> Mover:
    walks = kind in ("Pedestrian", "Cyclist")
    body, _, label, own = choose_body(kind, draw_size(kind, train_statistics(), rng), rng, whole_cycle=walks)
    cycle = {"Pedestrian": _STRIDE_M, "Cyclist": _PEDAL_M}.get(kind, 0.0) if len(body.phases) > 1 else 0.0
    return Mover(
        kind,
        body,
        label,
        own,
        draw_tint(kind, rng),
        s,
        t,
        speed_m_s,
        turn_rad,
        cycle,
        float(rng.uniform(0, 6.3)),
        **more,
    )


def _vehicle_kind(rng: np.random.Generator, *, trucks: float) -> str:
    return str(rng.choice(["Car", "Van", "Truck"], p=[0.88 - trucks, 0.12, trucks]))


def _traffic(
    rng: np.random.Generator, street: Street, *, length_m: float, ego_speed_m_s: float, duration_secs: float
) -> list[Mover]:  # fmt: skip
    movers: list[Mover] = []
    for t, along in street.parked_rows():
        fill = float(rng.uniform(0.45, 0.85))
        s = float(rng.uniform(2.0, 12.0))
        while s < length_m:
            clear = all(abs(s + 2.5 - centre) > street.junction_half_m + 6.0 for centre in street.junction_s_m)
            if clear and rng.random() < fill:
                facing = along if rng.random() < 0.88 else not along
                mover = _mover(
                    rng,
                    _vehicle_kind(rng, trucks=0.0),
                    s=s,
                    t=t + float(rng.normal(0, 0.1)),
                    turn_rad=(0.0 if facing else np.pi) + float(rng.normal(0, 0.02)),
                )
                half = 0.5 * mover.size_hwl[2]
                movers.append(replace(mover, s0_m=s + half))
                s += 2 * half + float(rng.uniform(0.6, 2.2))
            else:
                s += float(rng.uniform(3.0, 7.0))
    movers += _moving_vehicles(rng, street, length_m=length_m, ego_speed_m_s=ego_speed_m_s, duration_secs=duration_secs)
    movers += _people(rng, street, length_m=length_m, duration_secs=duration_secs)
    return movers


def _moving_vehicles(
    rng: np.random.Generator, street: Street, *, length_m: float, ego_speed_m_s: float, duration_secs: float
) -> list[Mover]:
    movers = []
    for t, along in street.lane_centres():
        turn = 0.0 if along else np.pi
        if along and t == 0.0:
            s = float(rng.uniform(14.0, 30.0))
            for _ in range(int(rng.integers(1, 4))):
                movers.append(
                    _mover(
                        rng,
                        _vehicle_kind(rng, trucks=0.08),
                        s=s,
                        t=float(rng.normal(0, 0.1)),
                        turn_rad=turn,
                        speed_m_s=ego_speed_m_s,
                        weave_m=float(rng.uniform(0.5, 2.0)),
                        weave_rate=float(rng.uniform(0.2, 0.5)),
                    )
                )
                s += float(rng.uniform(18.0, 40.0))
            continue
        speed = ego_speed_m_s * float(rng.uniform(0.85, 1.1)) * (1.0 if along else -1.0)
        first, last = (6.0, length_m) if along else (12.0, length_m + abs(speed) * duration_secs)
        s = first + float(rng.uniform(0.0, 25.0))
        while s < last:
            movers.append(
                _mover(
                    rng,
                    _vehicle_kind(rng, trucks=0.08),
                    s=s,
                    t=t + float(rng.normal(0, 0.12)),
                    turn_rad=turn,
                    speed_m_s=speed,
                )
            )
            s += float(rng.gamma(2.0, 22.0)) + 14.0
    return movers


def _people(rng: np.random.Generator, street: Street, *, length_m: float, duration_secs: float) -> list[Mover]:
    movers = []
    for side, edge in ((1.0, street.right_edge_m), (-1.0, street.left_edge_m)):
        inner = 0.7 + street.verge_m
        for _ in range(int(rng.poisson(length_m / 22.0))):
            s, t = (
                float(rng.uniform(4.0, length_m)),
                edge + side * float(rng.uniform(inner, inner + max(street.pavement_m - 0.9, 0.3))),
            )
            forward = bool(rng.random() < 0.5)
            mover = _mover(rng, "Pedestrian", s=s, t=t, turn_rad=0.0 if forward else np.pi)
            if len(mover.body.phases) > 1:
                movers.append(replace(mover, speed_m_s=float(rng.normal(1.3, 0.15)) * (1.0 if forward else -1.0)))
            else:
                movers.append(replace(mover, turn_rad=float(rng.uniform(-np.pi, np.pi))))
    for _ in range(int(rng.poisson(length_m / 70.0)) + 1):
        forward = bool(rng.random() < 0.5)
        t = (
            (street.lane_m * (street.lanes_right + 0.5) - 0.35)
            if forward
            else (-street.lane_m * (street.lanes_left + 0.5) + 0.35)
        )
        s = float(rng.uniform(10.0, length_m))
        movers.append(
            _mover(
                rng,
                "Cyclist",
                s=s,
                t=t,
                turn_rad=0.0 if forward else np.pi,
                speed_m_s=float(rng.normal(4.3, 0.5)) * (1.0 if forward else -1.0),
            )
        )
    for _ in range(int(rng.poisson(duration_secs / 6.0))):
        meet = float(rng.uniform(1.0, duration_secs + 2.0))  # crosses the middle about then, well before the ego car
        rate = float(rng.choice([-1.0, 1.0])) * float(rng.normal(1.3, 0.1))
        s = _EGO_SPEED_M_S * meet + float(rng.uniform(24.0, 50.0))
        mover = _mover(rng, "Pedestrian", s=s, t=-rate * meet - 1.0, turn_rad=np.pi / 2 * np.sign(rate))
        if len(mover.body.phases) > 1:
            movers.append(replace(mover, cross_m_s=rate))
    return movers


def moment_at(drive: Drive, time_secs: float) -> Moment:
    """The drive's world at a time: what stands near the ego car, and its camera."""
    ego_s = drive.speed_m_s * time_secs + 0.4 * np.sin(0.5 * time_secs)
    ego_t = 0.15 * np.sin(0.35 * time_secs + drive.seed % 7)
    objects = []
    for index, mover in enumerate(drive.movers):
        s, t, way = mover.at(time_secs)
        if ego_s - 6.0 < s < ego_s + _SEEN_AHEAD_M and s < drive.road.last_s_m:
            objects.append(_place(drive, mover, index + 1, pose=(s, t, way)))
    x, z = drive.road.to_world(ego_s, ego_t)
    y = float(drive.road.height_at(ego_s)) - drive.camera_height_m
    heading = float(drive.road.heading_at(ego_s)) + 0.006 * float(np.sin(0.8 * time_secs))
    scene = assemble(drive.surroundings, tuple(objects), drive.light, drive.seed % 100_003)
    return Moment(scene, tuple(objects), camera_pose(float(x), y, float(z), heading_rad=heading))


def _place(drive: Drive, mover: Mover, object_id: int, *, pose: tuple[float, float, float]) -> PlacedObject:
    s, t, way = pose
    x, z = drive.road.to_world(s, t)
    y = float(drive.road.height_at(s)) - drive.street.raised_at(s, t)
    yaw = float(drive.road.heading_at(s)) - 0.5 * np.pi + mover.turn_rad
    phases = len(mover.body.phases)
    phase = int((way / mover.cycle_m + mover.phase0) * phases) % phases if mover.cycle_m > 0 else 0
    return PlacedObject(
        mover.kind, mover.body, phase, mover.size_hwl, (float(x), y, float(z)), float(wrap_angle_rad(np.array(yaw))),
        mover.tint, object_id, mover.mesh_hwl,
    )  # fmt: skip
