"""Drives: identities and sizes last, motion is smooth, the world stands still."""

from __future__ import annotations

import numpy as np
import pytest

from edge.simulation.drive import Drive, build_drive, moment_at
from edge.simulation.label_statistics import CLASSES
from edge.simulation.placing import Footprint

FASTEST_M_S = 25.0  # oncoming traffic and the ego car together stay below
LONGEST_STEP_M = 0.1 * FASTEST_M_S
EGO_SPEED_TOLERANCE_M_S = 2.5  # drawn around 8 m/s with a deviation of 0.7


@pytest.fixture(scope="module")
def drive() -> Drive:
    return build_drive(7_301, 5.0)


def test_same_seed_same_drive(drive: Drive) -> None:
    again = build_drive(7_301, 5.0)
    assert [m.s0_m for m in again.movers] == [m.s0_m for m in drive.movers]
    assert moment_at(again, 1.3).objects == moment_at(drive, 1.3).objects


def test_identities_keep_class_size_and_colour(drive: Drive) -> None:
    known: dict[int, tuple[object, ...]] = {}
    for step in range(0, 50, 7):
        for item in moment_at(drive, 0.1 * step).objects:
            assert known.setdefault(item.object_id, (item.kind, item.size_hwl, item.tint)) == (
                item.kind, item.size_hwl, item.tint,
            )  # fmt: skip
    assert {kind for kind, *_ in known.values()} <= set(CLASSES)
    assert len(known) > 15


def test_objects_move_smoothly_and_some_stand(drive: Drive) -> None:
    before = {item.object_id: item for item in moment_at(drive, 2.0).objects}
    after = {item.object_id: item for item in moment_at(drive, 2.1).objects}
    steps = {
        key: float(np.linalg.norm(np.subtract(after[key].location, before[key].location)))
        for key in before.keys() & after
    }
    assert max(steps.values()) < LONGEST_STEP_M
    assert min(steps.values()) == 0.0, "parked cars"
    assert max(steps.values()) > 0.2, "moving traffic"


def test_who_moves_faces_where_it_goes(drive: Drive) -> None:
    before = {item.object_id: item for item in moment_at(drive, 2.0).objects}
    after = {item.object_id: item for item in moment_at(drive, 2.1).objects}
    ways = []
    for key in before.keys() & after:
        x, _, z = np.subtract(after[key].location, before[key].location)
        if np.hypot(x, z) > 0.02:
            yaw = before[key].yaw_rad
            ways.append((x * np.cos(yaw) - z * np.sin(yaw)) / np.hypot(x, z))
    assert len(ways) > 5 and min(ways) > 0.8
    crossing = [mover for seed in range(7_301, 7_311) for mover in build_drive(seed, 5.0).movers if mover.cross_m_s]
    assert crossing and all(np.sign(mover.cross_m_s) == np.sign(mover.turn_rad) for mover in crossing)


def test_ego_drives_at_about_eight_metres_a_second(drive: Drive) -> None:
    eyes = [
        -(m.camera_from_world[:3, :3].T @ m.camera_from_world[:3, 3]) for m in (moment_at(drive, t) for t in (0.0, 4.0))
    ]
    speed = float(np.linalg.norm(eyes[1] - eyes[0])) / 4.0
    assert speed == pytest.approx(8.0, abs=EGO_SPEED_TOLERANCE_M_S)


def test_scenery_is_the_same_in_every_frame(drive: Drive) -> None:
    first, later = (moment_at(drive, time).scene for time in (0.0, 3.0))
    still = [[i for i in scene.instances if i.object_id == 0] for scene in (first, later)]
    assert len(still[0]) == len(still[1]) > 20
    assert all(a is b for a, b in zip(*still, strict=True))


def test_vehicles_do_not_run_into_each_other(drive: Drive) -> None:
    for time in (0.0, 2.5, 4.9):
        bases = [
            Footprint(o.location[0], o.location[2], o.yaw_rad, length_m=o.size_hwl[2], width_m=o.size_hwl[1])
            for o in moment_at(drive, time).objects
            if o.kind in ("Car", "Van", "Truck")
        ]
        assert not any(a.overlaps(b) for i, a in enumerate(bases) for b in bases[:i])
