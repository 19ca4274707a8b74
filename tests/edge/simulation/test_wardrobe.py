"""Dressed people: another body in the same box, cars untouched, same seed same clothes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge.simulation.layout import lay_out
from edge.simulation.placing import PlacedObject
from edge.simulation.rig import kitti_rig
from edge.simulation.wardrobe import dress

BOX_TOLERANCE_M = 1e-3  # float32 vertices stretched by float64 matrices
SEEDS = (3, 8, 55)


def _people() -> tuple[PlacedObject, ...]:
    rig = kitti_rig()
    laid_out = [
        item
        for seed in SEEDS
        for item in lay_out(seed, intrinsics=np.array(rig.P2[:, :3]), size_wh=rig.image_size_wh).objects
    ]
    return tuple(item for item in laid_out if item.kind in ("Pedestrian", "Cyclist"))


def test_nobody_to_dress() -> None:
    assert dress((), np.random.default_rng(0)) == ()


def test_another_body_fills_the_same_box() -> None:
    people = _people() * 4
    dressed = dress(people, np.random.default_rng(5))
    changed = [(old, new) for old, new in zip(people, dressed, strict=True) if old.body is not new.body]
    assert len(changed) > 0.3 * len(people)
    for old, new in changed:
        assert replace(new, body=old.body, phase=old.phase, mesh_hwl=old.mesh_hwl) == old
        points = new.body.phases[new.phase].positions @ new.world_from_model()[:3, :3].T
        cos, sin = np.cos(-new.yaw_rad), np.sin(-new.yaw_rad)
        own = points @ np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]]).T
        extent = own.max(axis=0) - own.min(axis=0)
        assert extent[[1, 2, 0]] == pytest.approx(new.size_hwl, abs=BOX_TOLERANCE_M)


def test_same_chance_same_clothes_and_vehicles_stay() -> None:
    people = _people()
    first, again = (dress(people, np.random.default_rng(7)) for _ in range(2))
    assert first == again
    car = replace(people[0], kind="Car")
    assert dress((car,), np.random.default_rng(7)) == (car,)
