"""Mesh primitives: grids, tubes, boxes, ellipsoids, lathes; joining, moving and fitting them.

All functions are pure. Frames are the model frame of `edge.simulation.scene`: y points down.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from edge.simulation.scene import Material, Mesh

Rgb = tuple[float, float, float]
_TINY = 1e-9
_SEAM_GRID_PER_M, _SEAM_SPAN = 100_000, 1 << 21  # points nearer than 10 um are one; spans 20 m


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), _TINY)


def _cross(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """`numpy.cross` of (..., 3) arrays, without its overhead for small ones."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def shifted(point: NDArray[np.float64], offset: ArrayLike) -> NDArray[np.float64]:
    """A point (3,) moved by an offset."""
    return point + np.asarray(offset, dtype=np.float64)


def surface_grid(
    points: NDArray[np.float64],
    *,
    materials: ArrayLike,
    colours: ArrayLike,
    flip: bool = False,
    smooth: bool = True,
) -> Mesh:
    """A sheet of quads over a grid of points; cells of one material and colour share their vertices.

    Args:
        points: (R, C, 3) metres. The normal of a cell is (along columns) x (along rows), reversed by ``flip``.
        materials: scalar or (R - 1, C - 1), a `Material` per cell.
        colours: (3,) or (R - 1, C - 1, 3) linear RGB per cell.
        flip: turn the sheet's outer side round.
        smooth: average normals over neighbouring cells; else every cell is flat.
    """
    rows, columns = points.shape[:2]
    cell_materials = np.broadcast_to(np.asarray(materials, dtype=np.uint8), (rows - 1, columns - 1))
    cell_colours = np.broadcast_to(np.asarray(colours, dtype=np.float32), (rows - 1, columns - 1, 3))
    diagonal_a = points[1:, 1:] - points[:-1, :-1]
    diagonal_b = points[1:, :-1] - points[:-1, 1:]
    face_normals = _cross(diagonal_a, diagonal_b)
    if flip:
        face_normals = -face_normals
    corner = np.arange(rows * columns).reshape(rows, columns)
    quads = np.stack([corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]], axis=-1).reshape(-1, 4)
    if flip:
        quads = quads[:, ::-1]
    flat_materials = cell_materials.reshape(-1)
    flat_colours = cell_colours.reshape(-1, 3)
    if smooth:
        summed = np.zeros_like(points)
        for row_slice, column_slice in (
            (slice(None, -1), slice(None, -1)),
            (slice(None, -1), slice(1, None)),
            (slice(1, None), slice(None, -1)),
            (slice(1, None), slice(1, None)),
        ):
            summed[row_slice, column_slice] += face_normals
        grid_normals = _unit(summed).reshape(-1, 3)
        appearances = np.concatenate([flat_materials[:, None].astype(np.float32), flat_colours], axis=1)
        if np.ndim(materials) == 0 and np.ndim(colours) == 1:
            look, kind = appearances[:1], np.zeros(len(appearances), dtype=np.int64)
        else:
            look, kind = np.unique(appearances, axis=0, return_inverse=True)
        key = quads.astype(np.int64) * len(look) + kind.reshape(-1, 1)
        used, renumbered = np.unique(key, return_inverse=True)
        vertex, appearance = used // len(look), used % len(look)
        positions = points.reshape(-1, 3)[vertex]
        normals = grid_normals[vertex]
        vertex_materials = look[appearance, 0].astype(np.uint8)
        vertex_colours = look[appearance, 1:]
        quads = renumbered.reshape(-1, 4)
    else:
        positions = points.reshape(-1, 3)[quads.reshape(-1)]
        normals = np.repeat(_unit(face_normals.reshape(-1, 3)), 4, axis=0)
        vertex_materials = np.repeat(flat_materials, 4)
        vertex_colours = np.repeat(flat_colours, 4, axis=0)
        quads = np.arange(len(positions)).reshape(-1, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(
        positions.astype(np.float32),
        normals.astype(np.float32),
        np.ascontiguousarray(vertex_colours, dtype=np.float32),
        np.ascontiguousarray(vertex_materials),
        triangles.astype(np.int32),
    )


def box(low: ArrayLike, high: ArrayLike, *, material: Material, colour: Rgb, open_bottom: bool = False) -> Mesh:
    """An axis-aligned box between two corners; ``open_bottom`` leaves out the face at the largest y (y is down)."""
    x0, y0, z0 = np.minimum(low, high)
    x1, y1, z1 = np.maximum(low, high)
    corners = np.array(
        [[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0], [x0, y0, z1], [x1, y0, z1], [x1, y1, z1], [x0, y1, z1]]
    )
    faces = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [0, 4, 7, 3], [1, 2, 6, 5]]
    face_normals = [[0, 0, -1], [0, 0, 1], [0, -1, 0], [-1, 0, 0], [1, 0, 0]]
    if not open_bottom:
        faces.append([3, 7, 6, 2])
        face_normals.append([0, 1, 0])
    return quads_mesh(
        corners[np.array(faces)], np.array(face_normals, dtype=np.float64), material=material, colour=colour
    )


def quads_mesh(
    corners: NDArray[np.float64], normals: NDArray[np.float64], *, material: ArrayLike, colour: ArrayLike
) -> Mesh:
    """Separate flat quads: corners (Q, 4, 3), normals (Q, 3); material and colour scalar or per quad."""
    count = len(corners)
    quads = np.arange(4 * count).reshape(count, 4)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return Mesh(
        corners.reshape(-1, 3).astype(np.float32),
        np.repeat(normals, 4, axis=0).astype(np.float32),
        np.repeat(np.broadcast_to(np.asarray(colour, dtype=np.float32), (count, 3)), 4, axis=0),
        np.repeat(np.broadcast_to(np.asarray(material, dtype=np.uint8), (count,)), 4),
        triangles.astype(np.int32),
    )


def tube(
    path: ArrayLike, radii: ArrayLike, *, material: Material, colour: Rgb, sides: int = 8, capped: bool = True
) -> Mesh:
    """A round tube through points (P, 3) with a radius at each; ends closed by cones of no height when ``capped``."""
    centres = np.asarray(path, dtype=np.float64)
    radius = np.broadcast_to(np.asarray(radii, dtype=np.float64), (len(centres),))
    if capped:
        centres = np.concatenate([centres[:1], centres, centres[-1:]])
        radius = np.concatenate([[0.0], radius, [0.0]])
    tangents = _unit(np.gradient(np.asarray(path, dtype=np.float64), axis=0))
    if capped:
        tangents = np.concatenate([tangents[:1], tangents, tangents[-1:]])
    helper = np.where(np.abs(tangents[:, 1:2]) > 0.9, [[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]])
    side = _unit(_cross(helper, tangents))
    other = _cross(tangents, side)
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    ring = np.cos(angle)[None, :, None] * side[:, None, :] + np.sin(angle)[None, :, None] * other[:, None, :]
    points = centres[:, None, :] + radius[:, None, None] * ring
    return _outward(surface_grid(points, materials=material, colours=colour), ring_seam=True)


def ellipsoid(
    centre: ArrayLike, radii: ArrayLike, *, material: Material, colour: Rgb, sides: int = 10, rings: int = 6
) -> Mesh:
    """An ellipsoid with axis-aligned radii (3,)."""
    polar = np.linspace(0.0, np.pi, rings + 1)[:, None]
    around = np.linspace(0.0, 2.0 * np.pi, sides + 1)[None, :]
    sphere = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(around), -np.cos(polar), np.sin(polar) * np.sin(around)), -1
    )
    points = np.asarray(centre) + np.asarray(radii) * sphere
    mesh = surface_grid(points, materials=material, colours=colour)
    normals = _unit((mesh.positions - np.asarray(centre)) / np.asarray(radii) ** 2)
    return Mesh(
        mesh.positions,
        normals.astype(np.float32),
        mesh.colours,
        mesh.materials,
        _wound(mesh.positions, normals, mesh.triangles),
    )


def rounded_loft(
    centres: ArrayLike,
    half_sizes: ArrayLike,
    *,
    material: Material,
    colour: Rgb,
    sides: int = 10,
    squareness: float = 2.5,
) -> Mesh:
    """Superellipse sections stacked upwards: centres (S, 3) and half sizes (S, 2) along x and z."""
    middle = np.asarray(centres, dtype=np.float64)
    half = np.asarray(half_sizes, dtype=np.float64)
    middle = np.concatenate([middle[:1], middle, middle[-1:]])
    half = np.concatenate([np.zeros((1, 2)), half, np.zeros((1, 2))])
    angle = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    cos, sin = np.cos(angle), np.sin(angle)
    power = 2.0 / squareness
    shape = np.stack([np.sign(cos) * np.abs(cos) ** power, np.sign(sin) * np.abs(sin) ** power], axis=-1)
    points = np.repeat(middle[:, None, :], sides + 1, axis=1)
    points[..., 0] += half[:, None, 0] * shape[None, :, 0]
    points[..., 2] += half[:, None, 1] * shape[None, :, 1]
    return _outward(surface_grid(points, materials=material, colours=colour), ring_seam=True)


def disc(
    centre: ArrayLike,
    *,
    axis: int,
    radius: float,
    material: Material,
    colour: ArrayLike,
    inner: float = 0.0,
    sign: float = 1.0,
    sides: int = 16,
    arc: tuple[float, float] = (0.0, 2.0 * np.pi),
) -> Mesh:
    """A flat disc or ring across an axis (0 x, 1 y, 2 z), facing ``sign``; colour (3,) or one a side (sides, 3)."""
    angle = np.linspace(*arc, sides + 1)
    plane = [index for index in range(3) if index != axis]
    points = np.zeros((2, sides + 1, 3)) + np.asarray(centre)
    for row, size in enumerate((inner, radius)):
        points[row, :, plane[0]] += size * np.cos(angle)
        points[row, :, plane[1]] += size * np.sin(angle)
    colours = np.broadcast_to(np.asarray(colour, dtype=np.float32), (sides, 3))[None]
    mesh = surface_grid(points, materials=material, colours=colours, smooth=False)
    normals = np.zeros_like(mesh.positions)
    normals[:, axis] = sign
    return Mesh(mesh.positions, normals, mesh.colours, mesh.materials, _wound(mesh.positions, normals, mesh.triangles))


def _wound(positions: NDArray, normals: NDArray, triangles: NDArray[np.int32]) -> NDArray[np.int32]:
    """Triangles turned so that their winding agrees with the vertex normals."""
    a, b, c = (positions[triangles[:, k]].astype(np.float64) for k in range(3))
    wrong = np.einsum("ij,ij->i", _cross(b - a, c - a), normals[triangles].sum(axis=1)) < 0
    turned = triangles.copy()
    turned[wrong] = triangles[wrong][:, [0, 2, 1]]
    return turned


def _outward(mesh: Mesh, *, ring_seam: bool) -> Mesh:
    """Normals and winding away from the centroid line of a closed tube-like mesh; seams get equal normals."""
    normals = mesh.normals.astype(np.float64)
    if ring_seam:
        grid = np.rint(mesh.positions.astype(np.float64) * _SEAM_GRID_PER_M).astype(np.int64)
        _, group = np.unique((grid[:, 0] * _SEAM_SPAN + grid[:, 1]) * _SEAM_SPAN + grid[:, 2], return_inverse=True)
        total = np.zeros((group.max() + 1, 3))
        np.add.at(total, group, normals)
        normals = _unit(total)[group]
    triangles = mesh.triangles
    a, b, c = (mesh.positions[triangles[:, k]].astype(np.float64) for k in range(3))
    volume = np.einsum("ij,ij->i", a - mesh.positions.mean(axis=0), _cross(b - a, c - a)).sum()
    if volume < 0:
        triangles = triangles[:, [0, 2, 1]]
    a, b, c = (mesh.positions[triangles[:, k]].astype(np.float64) for k in range(3))
    agree = np.einsum("ij,ij->i", _cross(b - a, c - a), normals[triangles].sum(axis=1)).sum()
    if agree < 0:
        normals = -normals
    return Mesh(
        mesh.positions, normals.astype(np.float32), mesh.colours, mesh.materials, np.ascontiguousarray(triangles)
    )


def join(parts: Sequence[Mesh]) -> Mesh:
    """All parts as one mesh."""
    offsets = np.cumsum([0] + [len(part.positions) for part in parts[:-1]])
    return Mesh(
        np.concatenate([part.positions for part in parts]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.colours for part in parts]),
        np.concatenate([part.materials for part in parts]),
        np.concatenate([part.triangles + offset for part, offset in zip(parts, offsets, strict=True)]).astype(np.int32),
    )


def transformed(mesh: Mesh, matrix: NDArray[np.float64]) -> Mesh:
    """The mesh moved by a (4, 4) matrix; normals by the inverse transpose, winding kept outward under mirroring."""
    linear = matrix[:3, :3]
    positions = mesh.positions @ linear.T + matrix[:3, 3]
    normals = _unit(mesh.normals @ np.linalg.inv(linear))
    triangles = mesh.triangles[:, [0, 2, 1]] if np.linalg.det(linear) < 0 else mesh.triangles
    return Mesh(
        positions.astype(np.float32),
        normals.astype(np.float32),
        mesh.colours,
        mesh.materials,
        np.ascontiguousarray(triangles),
    )


def fitted(mesh: Mesh, size_hwl: ArrayLike) -> Mesh:
    """The mesh stretched so that its extent is exactly (h, w, l), standing on y = 0, centred in x and z."""
    height, width, length = (float(value) for value in np.asarray(size_hwl))
    low = mesh.positions.min(axis=0).astype(np.float64)
    high = mesh.positions.max(axis=0).astype(np.float64)
    scale = np.array([length, height, width]) / np.maximum(high - low, _TINY)
    middle = 0.5 * (low + high)
    matrix = np.diag([*scale, 1.0])
    matrix[:3, 3] = -scale * np.array([middle[0], high[1], middle[2]])
    return transformed(mesh, matrix)


def extent_hwl(mesh: Mesh) -> NDArray[np.float64]:
    """(h, w, l) of the mesh in metres."""
    size = mesh.positions.max(axis=0).astype(np.float64) - mesh.positions.min(axis=0)
    return size[[1, 2, 0]]
