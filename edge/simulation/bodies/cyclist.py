"""Riders on bicycles, with a pedal phase."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge.simulation.bodies.person import PersonLook, torso_parts
from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import box, ellipsoid, fitted, join, shifted, tube

Rgb = tuple[float, float, float]
_WHEEL_RADIUS_M = 0.345
_AXLE_X_M = 0.53
_CRANK_M = 0.17
_TYRE: Rgb = (0.022, 0.022, 0.024)
_SHOE: Rgb = (0.03, 0.028, 0.026)


def _hoop(x: float) -> list[Mesh]:
    angle = np.linspace(0.0, 2.0 * np.pi, 19)
    path = np.stack(
        [x + _WHEEL_RADIUS_M * np.cos(angle), -_WHEEL_RADIUS_M - 0.02 + _WHEEL_RADIUS_M * np.sin(angle), np.zeros(19)],
        -1,
    )
    parts = [tube(path, 0.021, material=Material.RUBBER, colour=_TYRE, sides=5, capped=False)]
    for turn in np.linspace(0.0, np.pi, 6, endpoint=False):
        reach = 0.96 * _WHEEL_RADIUS_M * np.array([np.cos(turn), np.sin(turn), 0.0])
        hub = np.array([x, -_WHEEL_RADIUS_M - 0.02, 0.0])
        parts.append(
            tube(
                [hub - reach, hub + reach],
                0.004,
                material=Material.METAL,
                colour=(0.3, 0.3, 0.3),
                sides=3,
                capped=False,
            )
        )
    return parts


def bicycle_parts(frame_colour: Rgb, *, basket: bool = False) -> list[Mesh]:
    """A bicycle facing +x, wheels in the plane z = 0."""
    crank = np.array([-0.05, -0.32, 0.0])
    seat = np.array([-0.2, -0.93, 0.0])
    head_low, head_high = np.array([0.36, -0.68, 0.0]), np.array([0.31, -0.93, 0.0])
    rear, front = np.array([-_AXLE_X_M, -0.365, 0.0]), np.array([_AXLE_X_M, -0.365, 0.0])
    bar = np.array([0.33, -1.06, 0.0])
    parts = _hoop(-_AXLE_X_M) + _hoop(_AXLE_X_M)
    for path in (
        [crank, seat],
        [crank, head_low],
        [shifted(seat, [0.04, 0.15, 0]), head_high],
        [rear, crank],
        [rear, shifted(seat, [0.04, 0.18, 0])],
    ):
        parts.append(tube(path, 0.018, material=Material.CAR_PAINT, colour=frame_colour, sides=6))
    parts.append(
        tube([front, head_low, head_high, bar], 0.016, material=Material.METAL, colour=(0.25, 0.25, 0.26), sides=6)
    )
    parts.append(
        tube(
            [
                shifted(bar, [-0.06, 0.02, -0.29]),
                shifted(bar, [0.04, 0, -0.1]),
                shifted(bar, [0.04, 0, 0.1]),
                shifted(bar, [-0.06, 0.02, 0.29]),
            ],
            0.014,
            material=Material.METAL,
            colour=(0.1, 0.1, 0.1),
            sides=6,
        )
    )
    parts.append(
        ellipsoid(
            shifted(seat, [-0.02, -0.02, 0]),
            (0.14, 0.04, 0.075),
            material=Material.RUBBER,
            colour=_TYRE,
            sides=8,
            rings=4,
        )
    )
    parts.append(box((-0.86, -0.74, -0.07), (-0.35, -0.715, 0.07), material=Material.METAL, colour=(0.08, 0.08, 0.08)))
    if basket:
        parts.append(box((0.4, -1.02, -0.17), (0.7, -0.8, 0.17), material=Material.METAL, colour=(0.1, 0.09, 0.08)))
    return parts


def _knee(hip: NDArray[np.float64], ankle: NDArray[np.float64], bone: float) -> NDArray[np.float64]:
    """The knee of a two-bone leg with equal bones, bent forward."""
    middle = 0.5 * (hip + ankle)
    span = np.linalg.norm(ankle - hip)
    out = np.sqrt(max(bone**2 - 0.25 * span**2, 1e-4))
    axis = (ankle - hip) / span
    forward = np.array([axis[1], -axis[0], 0.0])
    return middle + out * forward * np.sign(forward[0] or 1.0)


def build_cyclist(
    look: PersonLook, phase: float, *, frame_colour: Rgb, lean_rad: float, helmet: bool, basket: bool
) -> Mesh:
    """A rider pedalling, natural extent, standing on y = 0, facing +x."""
    parts = bicycle_parts(frame_colour, basket=basket)
    hip = np.array([-0.19, -1.0, 0.0])
    crank = np.array([-0.05, -0.32, 0.0])
    for side, turn in ((-1.0, phase), (1.0, phase + 0.5)):
        pedal = shifted(
            crank + _CRANK_M * np.array([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn), 0.0]), [0, 0, side * 0.11]
        )
        ankle = shifted(pedal, [-0.04, -0.1, 0.0])
        root = shifted(hip, [0.0, 0.0, side * 0.09])
        knee = _knee(root, ankle, 0.46)
        knee[2] = side * 0.11
        parts.append(
            tube(
                [root, knee, ankle],
                np.array([0.09, 0.065, 0.048]) * look.girth,
                material=Material.CLOTH,
                colour=look.trousers,
                sides=8,
            )
        )
        parts.append(
            ellipsoid(
                shifted(ankle, [0.06, 0.06, 0.0]),
                (0.13, 0.045, 0.045),
                material=Material.RUBBER,
                colour=_SHOE,
                sides=8,
                rings=4,
            )
        )
        shoulder = shifted(hip, [0.5 * np.sin(lean_rad), -0.5 * np.cos(lean_rad), side * 0.2 * look.girth])
        hand = np.array([0.28, -1.07, side * 0.27])
        elbow = shifted(0.5 * (shoulder + hand), [-0.03, 0.06, side * 0.05])
        lower = Material.SKIN if look.short_sleeves else Material.CLOTH
        parts.append(tube([shoulder, elbow], [0.055, 0.045], material=Material.CLOTH, colour=look.top, sides=7))
        parts.append(
            tube(
                [elbow, hand],
                [0.043, 0.034],
                material=lower,
                colour=look.skin if look.short_sleeves else look.top,
                sides=7,
            )
        )
    parts += torso_parts(look, hip_y=float(hip[1]), lean_rad=lean_rad, hip_x=float(hip[0]), helmet=helmet)
    if look.bag == "backpack":
        back = shifted(hip, [0.28 * np.sin(lean_rad) - 0.2, -0.3 * np.cos(lean_rad), 0.0])
        parts.append(
            box(
                shifted(back, [-0.09, -0.2, -0.15]),
                shifted(back, [0.09, 0.2, 0.15]),
                material=Material.CLOTH,
                colour=(0.06, 0.06, 0.09),
            )
        )
    mesh = join(parts)
    size = mesh.positions.max(axis=0) - mesh.positions.min(axis=0)
    return fitted(mesh, (size[1], size[2], size[0]))
