"""Compiles the shader programs and sets their uniforms."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.simulation.render import shaders_common as common
from edge.simulation.render.noise import NOISE_SIZE, noise_tile
from edge.simulation.render.shaders_materials import MATERIAL_PROGRAMS
from edge.simulation.scene import Material

GROUP_NAMES = tuple(MATERIAL_PROGRAMS)
HOLED_GROUP = "foliage"
assert GROUP_NAMES[-1] == HOLED_GROUP
NOISE_UNIT, SHADOW_UNIT, COVER_UNIT = 0, 1, 2
_SHADOW_FOOTPRINT = "0.05"
_VIEW_FOOTPRINT = "length(v_world - u_eye) * u_metres_per_pixel_at_1m"
_SHADOW_FACING = "0.3"  # sun comes through a crown here and there
_VIEW_FACING = "abs(dot(normalize(v_normal), normalize(v_world - u_eye)))"


def group_of_material() -> NDArray[np.int64]:
    """(materials,) index into `GROUP_NAMES` for each material value."""
    table = np.zeros(len(Material), np.int64)
    for index, (materials, _) in enumerate(MATERIAL_PROGRAMS.values()):
        table[[int(material) for material in materials]] = index
    return table


class Programs:
    """All compiled programs by name, and the noise texture that they share."""

    def __init__(self, context: Any) -> None:
        sources: dict[str, tuple[str, str]] = {
            name: (common.COLOUR_VERTEX, fragment) for name, (_, fragment) in MATERIAL_PROGRAMS.items()
        }
        for kind, fragment, footprint, facing in (
            ("identity", common.IDENTITY_FRAGMENT, _VIEW_FOOTPRINT, _VIEW_FACING),
            ("shadow", common.SHADOW_FRAGMENT, _SHADOW_FOOTPRINT, _SHADOW_FACING),
            ("cover", common.HEIGHT_FRAGMENT, _SHADOW_FOOTPRINT, "1.0"),
        ):
            sources[f"{kind}/solid"] = (common.PLAIN_VERTEX, common.solid(fragment))
            sources[f"{kind}/holed"] = (common.PLAIN_VERTEX, common.leafy(fragment, footprint=footprint, facing=facing))
        sources["sky"] = (common.SKY_VERTEX, common.SKY_FRAGMENT)
        self._programs = {
            name: context.program(vertex_shader=vertex, fragment_shader=fragment)
            for name, (vertex, fragment) in sources.items()
        }
        self.noise = context.texture((NOISE_SIZE, NOISE_SIZE), 4, noise_tile().tobytes())
        self.noise.build_mipmaps()
        self.noise.filter = (context.LINEAR_MIPMAP_NEAREST, context.LINEAR)
        self.set_all(u_noise=NOISE_UNIT, u_shadow=SHADOW_UNIT, u_cover=COVER_UNIT)

    def __getitem__(self, name: str) -> Any:
        return self._programs[name]

    def set_all(self, **values: Any) -> None:
        """Set uniforms in every program that has them (compilers drop those that a program does not use)."""
        for program in self._programs.values():
            set_uniforms(program, **values)

    def release(self) -> None:
        """Free GPU memory."""
        for program in self._programs.values():
            program.release()
        self.noise.release()


def set_uniforms(program: Any, **values: Any) -> None:
    """Set the uniforms that ``program`` has. Matrices are given row-major, numpy's way."""
    for name, value in values.items():
        member = program.get(name, None)
        if member is None:
            continue
        if isinstance(value, np.ndarray) and value.ndim == 2:
            member.write(np.ascontiguousarray(value.T, np.float32).tobytes())
        elif isinstance(value, np.ndarray):
            member.value = tuple(float(item) for item in value)
        else:
            member.value = value
