"""Meshes on the GPU: uploaded once while scenes keep using them, drawn with hardware instancing.

A mesh is split by material group at upload, so that each group is drawn by its own program.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.simulation.scene import Instance, Mesh, Scene

KEPT_UNUSED_FRAMES = 12
_VERTEX_FLOATS = 10  # position 3, normal 3, colour 3, material 1
VERTEX_FORMAT = "3f4 3f4 3f4 1f4"
VERTEX_NAMES = ("in_position", "in_normal", "in_colour", "in_material")
INSTANCE_FORMAT = "4f4 4f4 4f4 4f4 1i4/i"
INSTANCE_NAMES = ("in_row0", "in_row1", "in_row2", "in_tint_seed", "in_object_id")
_INSTANCE_WORDS = 17


@dataclass(slots=True)
class UploadedMesh:
    """One mesh in GPU memory. ``ranges`` maps material group to (first index, index count)."""

    mesh: Mesh  # kept, so that its identity stays taken
    vertices: Any
    indices: Any
    ranges: dict[str, tuple[int, int]]
    centre: NDArray[np.float64]
    radius_m: float
    instances: Any
    arrays: dict[str, Any] = field(default_factory=dict)
    last_used_frame: int = 0

    def release(self) -> None:
        """Free GPU memory."""
        for resource in (*self.arrays.values(), self.vertices, self.indices, self.instances):
            resource.release()


@dataclass(frozen=True, slots=True)
class PlacedMesh:
    """All instances of one mesh in a scene, relative to the frame's origin.

    Attributes:
        words: (N, 17) float32 as the vertex stage reads them; the last column holds int32 object ids bitwise.
        centres: (N, 3) bounding sphere centres.
        radii_m: (N,) bounding sphere radii.
        object_ids: (N,) int32.
        mirrored: whether any placement turns the mesh inside out.
    """

    uploaded: UploadedMesh
    words: NDArray[np.float32]
    centres: NDArray[np.float64]
    radii_m: NDArray[np.float64]
    object_ids: NDArray[np.int32]
    mirrored: bool


class GeometryCache:
    """Holds uploaded meshes by identity and lets go of those that no scene has used for a while."""

    def __init__(self, context: Any, *, group_of_material: NDArray[np.int64], group_names: tuple[str, ...]) -> None:
        """``group_of_material[m]`` indexes ``group_names``; groups are laid out in the order of the names."""
        self._context = context
        self._group_of_material = group_of_material
        self._group_names = group_names
        self._uploaded: dict[int, UploadedMesh] = {}
        self._frame = 0

    def __len__(self) -> int:
        return len(self._uploaded)

    def place(self, scene: Scene, origin: NDArray[np.float64]) -> list[PlacedMesh]:
        """Upload what is new, forget what is stale, and gather instances by mesh."""
        self._frame += 1
        grouped: dict[str, list[Instance]] = {}
        for instance in scene.instances:
            grouped.setdefault(instance.mesh, []).append(instance)
        placed = []
        for name, instances in grouped.items():
            uploaded = self._get(scene.meshes[name])
            if uploaded is not None:
                placed.append(_gather(uploaded, instances, origin))
        for key, uploaded in list(self._uploaded.items()):
            if self._frame - uploaded.last_used_frame > KEPT_UNUSED_FRAMES:
                uploaded.release()
                del self._uploaded[key]
        return placed

    def release(self) -> None:
        """Free all GPU memory."""
        for uploaded in self._uploaded.values():
            uploaded.release()
        self._uploaded.clear()

    def _get(self, mesh: Mesh) -> UploadedMesh | None:
        uploaded = self._uploaded.get(id(mesh))
        if uploaded is None:
            if not len(mesh.triangles):
                return None
            uploaded = self._upload(mesh)
            self._uploaded[id(mesh)] = uploaded
        uploaded.last_used_frame = self._frame
        return uploaded

    def _upload(self, mesh: Mesh) -> UploadedMesh:
        packed = np.empty((len(mesh.positions), _VERTEX_FLOATS), np.float32)
        packed[:, 0:3], packed[:, 3:6], packed[:, 6:9] = mesh.positions, mesh.normals, mesh.colours
        packed[:, 9] = mesh.materials
        triangles = _turned_outward(mesh)
        # the last vertex of a triangle provokes: its material colours the whole triangle
        group = self._group_of_material[mesh.materials[triangles[:, 2]]]
        order = np.argsort(group, kind="stable")
        counts = np.bincount(group, minlength=len(self._group_names)) * 3
        firsts = np.concatenate([[0], np.cumsum(counts)])
        ranges = {
            name: (int(firsts[index]), int(counts[index]))
            for index, name in enumerate(self._group_names)
            if counts[index]
        }
        low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
        centre = (low.astype(float) + high) / 2
        return UploadedMesh(
            mesh=mesh,
            vertices=self._context.buffer(packed.tobytes()),
            indices=self._context.buffer(np.ascontiguousarray(triangles[order], np.int32).tobytes()),
            ranges=ranges,
            centre=centre,
            radius_m=float(np.linalg.norm(mesh.positions - centre, axis=1).max()),
            instances=self._context.buffer(reserve=_INSTANCE_WORDS * 4 * 4, dynamic=True),
        )


def _turned_outward(mesh: Mesh) -> NDArray[np.int32]:
    """(T, 3) triangles whose winding agrees with their vertex normals, so that back faces can be culled."""
    a, b, c = (mesh.positions[mesh.triangles[:, corner]] for corner in range(3))
    wrong = np.einsum("ij,ij->i", np.cross(b - a, c - a), mesh.normals[mesh.triangles].sum(axis=1)) < 0.0
    triangles = mesh.triangles.copy()
    triangles[wrong] = mesh.triangles[wrong][:, [1, 0, 2]]
    return triangles


class InstanceDrawer:
    """Draws placed meshes with given programs.

    Back faces of surfaces with holes (foliage: closed blobs) are culled, which halves the cost of woods; all
    other surfaces may be thin sheets and are drawn from both sides.
    """

    def __init__(self, context: Any, *, holed_group: str) -> None:
        self._context = context
        self._holed_group = holed_group

    def load(self, placed: PlacedMesh, chosen: NDArray[np.int64]) -> None:
        """Write the chosen instances, in their order, for the draws that follow."""
        data = placed.words[chosen].tobytes()
        buffer = placed.uploaded.instances
        if buffer.size < len(data):
            for array in placed.uploaded.arrays.values():
                array.release()
            placed.uploaded.arrays.clear()
            buffer.release()
            placed.uploaded.instances = self._context.buffer(data, dynamic=True)
        else:
            buffer.orphan()
            buffer.write(data)

    def faces_out(self, *, clockwise: bool) -> None:
        """Say which winding outer faces have in the target that is drawn to next."""
        self._context.front_face = "cw" if clockwise else "ccw"

    def draw(self, placed: PlacedMesh, program: tuple[str, Any], *, span: tuple[int, int], count: int) -> None:
        """Draw ``span`` = (first index, index count) of ``count`` loaded instances with (name, program)."""
        name, shader = program
        uploaded = placed.uploaded
        array = uploaded.arrays.get(name)
        if array is None:
            array = self._context.vertex_array(
                shader,
                [
                    (uploaded.vertices, VERTEX_FORMAT, *VERTEX_NAMES),
                    (uploaded.instances, INSTANCE_FORMAT, *INSTANCE_NAMES),
                ],
                index_buffer=uploaded.indices,
                index_element_size=4,
                skip_errors=True,
            )
            uploaded.arrays[name] = array
        culled = span == uploaded.ranges.get(self._holed_group) and not placed.mirrored
        if culled:
            self._context.enable(self._context.CULL_FACE)
        array.render(vertices=span[1], first=span[0], instances=count)
        if culled:
            self._context.disable(self._context.CULL_FACE)


def spans_of(uploaded: UploadedMesh, *, holed_group: str) -> Iterator[tuple[bool, tuple[int, int]]]:
    """The mesh's index spans for geometry-only passes: (has holes, (first, count)); solid groups joined."""
    holed = uploaded.ranges.get(holed_group)
    total = sum(count for _, count in uploaded.ranges.values())
    solid_count = total - (holed[1] if holed else 0)
    if solid_count:
        yield False, (0, solid_count)
    if holed:
        yield True, holed


def _gather(uploaded: UploadedMesh, instances: list[Instance], origin: NDArray[np.float64]) -> PlacedMesh:
    matrices = np.array([instance.world_from_model[:3] for instance in instances], np.float64)
    matrices[:, :, 3] -= origin
    ids = np.array([instance.object_id for instance in instances], np.int32)
    words = np.empty((len(instances), _INSTANCE_WORDS), np.float32)
    words[:, :12] = matrices.reshape(-1, 12)
    words[:, 12:15] = [instance.tint for instance in instances]
    words[:, 15] = [instance.texture_seed for instance in instances]
    words[:, 16] = ids.view(np.float32)
    scale = np.linalg.norm(matrices[:, :, :3], axis=1).max(axis=1)
    return PlacedMesh(
        uploaded=uploaded,
        words=words,
        centres=matrices[:, :, :3] @ uploaded.centre + matrices[:, :, 3],
        radii_m=uploaded.radius_m * scale,
        object_ids=ids,
        mirrored=bool((np.linalg.det(matrices[:, :, :3]) < 0.0).any()),
    )
