"""The library's meshes: sound geometry, and an extent that is the label's size."""

from __future__ import annotations

import numpy as np
import pytest

from edge.simulation.bodies.library import BODY_COUNTS, bodies
from edge.simulation.label_statistics import train_statistics
from edge.simulation.placing import choose_body, draw_size
from edge.simulation.scene import Material, Mesh
from edge.simulation.scenery import buildings, furniture, plants
from edge.simulation.scenery.lookalikes import KINDS, VARIANTS, lookalike
from edge.simulation.solids import box, extent_hwl, fitted, join, transformed

EXTENT_TOLERANCE_M = 1e-4  # float32 vertices of bodies up to 12 m
NORMAL_TOLERANCE = 1e-3  # float32 unit vectors
MOST_TRIANGLES = 3000  # thirty bodies a frame must stay cheap


def _check_sound(mesh: Mesh) -> None:
    assert np.isfinite(mesh.positions).all() and np.isfinite(mesh.normals).all()
    lengths = np.linalg.norm(mesh.normals, axis=1)
    assert np.abs(lengths - 1.0).max() < NORMAL_TOLERANCE
    assert mesh.triangles.min() >= 0 and mesh.triangles.max() < len(mesh.positions)
    assert set(np.unique(mesh.materials)) <= set(Material)
    assert mesh.colours.min() >= 0.0 and mesh.colours.max() <= 1.0
    assert mesh.positions.dtype == mesh.normals.dtype == mesh.colours.dtype == np.float32
    assert mesh.triangles.dtype == np.int32


@pytest.mark.parametrize("kind", list(BODY_COUNTS))
def test_every_body_is_sound_and_fills_its_box(kind: str) -> None:
    for body in bodies(kind):
        for mesh, size in zip(body.phases, body.size_hwl, strict=True):
            _check_sound(mesh)
            assert len(mesh.triangles) <= MOST_TRIANGLES
            low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
            assert np.abs(extent_hwl(mesh) - size).max() < EXTENT_TOLERANCE_M
            assert abs(high[1]) < EXTENT_TOLERANCE_M, "stands on y = 0"
            assert np.abs((low + high)[[0, 2]]).max() < 2 * EXTENT_TOLERANCE_M, "centred"


@pytest.mark.parametrize("kind", list(BODY_COUNTS))
def test_placed_bodies_have_the_label_size(kind: str) -> None:
    rng = np.random.default_rng(4)
    for _ in range(20):
        wanted = draw_size(kind, train_statistics(), rng)
        body, phase, label, own = choose_body(kind, wanted, rng)
        scale = np.array(label) / np.array(own)
        assert np.abs(extent_hwl(body.phases[phase]) * scale - label).max() < 2 * EXTENT_TOLERANCE_M
        assert (np.abs(np.log(scale)) < np.log(1.21)).all(), "bodies are not stretched out of shape"


def test_gait_moves_the_legs_and_keeps_the_height() -> None:
    walker = next(body for body in bodies("Pedestrian") if len(body.phases) > 1)
    lengths = walker.size_hwl[:, 2]
    assert lengths.max() > 1.3 * lengths.min()
    assert (walker.cycle_hwl >= walker.size_hwl - EXTENT_TOLERANCE_M).all()


def test_scenery_is_sound() -> None:
    meshes = [maker(index)[0] for maker in (buildings.block, buildings.house, buildings.hall) for index in range(6)]
    meshes += [plants.tree(index, coarse) for index in range(4) for coarse in (False, True)]
    meshes += [plants.conifer(0), plants.bush(1), plants.hedge(2), plants.tree_line(0)]
    meshes += [furniture.sign(index) for index in range(furniture.SIGN_COUNT)]
    meshes += [furniture.fence(index) for index in range(4)] + [furniture.bin_or_box(index) for index in range(3)]
    meshes += [furniture.lamp_post(0), furniture.mast(), furniture.shelter(), furniture.parked_bicycle(1)]
    meshes += [lookalike(kind, index) for kind in KINDS for index in range(VARIANTS)]
    for mesh in meshes:
        _check_sound(mesh)


def test_box_faces_point_outwards() -> None:
    cube = box((-1, -2, -3), (1, 0, 3), material=Material.MATTE, colour=(0.5, 0.5, 0.5))
    a, b, c = (cube.positions[cube.triangles[:, k]] for k in range(3))
    winding = np.cross(b - a, c - a)
    outward = (a + b + c) / 3.0 - np.array([0.0, -1.0, 0.0])
    normals = cube.normals[cube.triangles[:, 0]]
    assert (np.einsum("ij,ij->i", winding, outward) > 0).all()
    assert (np.einsum("ij,ij->i", normals, outward) > 0).all()


def test_fitting_and_mirroring_keep_outsides_out() -> None:
    cube = box((0, -1, 0), (1, 0, 2), material=Material.MATTE, colour=(0.5, 0.5, 0.5))
    pair = join([cube, transformed(cube, np.diag([-1.0, 1.0, 1.0, 1.0]))])
    assert len(pair.positions) == 2 * len(cube.positions)
    stretched = fitted(pair, (1.5, 1.7, 4.0))
    assert extent_hwl(stretched) == pytest.approx((1.5, 1.7, 4.0), abs=EXTENT_TOLERANCE_M)
    a, b, c = (stretched.positions[stretched.triangles[:, k]] for k in range(3))
    normals = stretched.normals[stretched.triangles[:, 0]]
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), normals) > 0).all()
