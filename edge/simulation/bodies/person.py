"""Walking and standing people: legs and arms swung by a gait phase, clothes, hair, bags."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edge.simulation.scene import Material, Mesh
from edge.simulation.solids import box, ellipsoid, fitted, join, rounded_loft, shifted, tube

Rgb = tuple[float, float, float]
_SKINS: tuple[Rgb, ...] = ((0.55, 0.33, 0.24), (0.62, 0.40, 0.30), (0.35, 0.19, 0.12), (0.14, 0.07, 0.045))
_HAIRS: tuple[Rgb, ...] = ((0.02, 0.015, 0.01), (0.07, 0.04, 0.02), (0.22, 0.14, 0.06), (0.25, 0.25, 0.25))
_TOPS: tuple[Rgb, ...] = (
    (0.02, 0.02, 0.025), (0.06, 0.06, 0.07), (0.65, 0.65, 0.63), (0.03, 0.06, 0.16), (0.3, 0.03, 0.03),
    (0.12, 0.2, 0.3),    (0.35, 0.3, 0.22), (0.05, 0.12, 0.06), (0.5, 0.3, 0.1), (0.25, 0.08, 0.18), (0.4, 0.42, 0.45),
)  # fmt: skip
_TROUSERS: tuple[Rgb, ...] = (
    (0.02, 0.02, 0.025),
    (0.035, 0.05, 0.11),
    (0.07, 0.1, 0.18),
    (0.12, 0.11, 0.1),
    (0.28, 0.24, 0.17),
)
_SHOE: Rgb = (0.03, 0.028, 0.026)


@dataclass(frozen=True, slots=True)
class PersonLook:
    """What stays the same over a person's gait."""

    skin: Rgb
    hair: Rgb
    top: Rgb
    trousers: Rgb
    stride_rad: float
    girth: float
    long_hair: bool
    coat: bool
    skirt: bool
    short_sleeves: bool
    bag: str  # "", "backpack", "shoulder", "hand"
    pose: str = "swing"  # of the arms: "swing", "pockets", "phone", "carry", "folded"
    hat: str = ""  # "", "cap", "hood", "brim"
    second: Rgb | None = None  # a band or a vest over the top
    shorts: bool = False

    @staticmethod
    def draw_any(rng: np.random.Generator) -> PersonLook:
        """A person of a wider range: other colours, arms, hats, vests, bare legs."""
        look = PersonLook.draw(rng)
        tones = [_any_cloth(rng) for _ in range(3)]
        return replace(
            look,
            top=tones[0] if rng.random() < 0.6 else look.top,
            trousers=tones[1] if rng.random() < 0.35 else look.trousers,
            second=tones[2] if rng.random() < 0.3 else None,
            pose=str(rng.choice(["swing", "pockets", "phone", "carry", "folded"], p=[0.55, 0.15, 0.1, 0.1, 0.1])),
            hat=str(rng.choice(["", "cap", "hood", "brim"], p=[0.7, 0.12, 0.12, 0.06])),
            shorts=not look.skirt and bool(rng.random() < 0.15),
            coat=bool(rng.random() < 0.35),
            girth=float(np.clip(rng.normal(1.03, 0.11), 0.85, 1.35)),
            stride_rad=float(rng.uniform(0.1, 0.55)),
        )

    @staticmethod
    def draw(rng: np.random.Generator) -> PersonLook:
        """A random person."""
        skirt = bool(rng.random() < 0.12)
        return PersonLook(
            skin=_SKINS[rng.choice(4, p=[0.4, 0.4, 0.12, 0.08])],
            hair=_HAIRS[rng.integers(4)],
            top=_TOPS[rng.integers(len(_TOPS))],
            trousers=_TROUSERS[rng.integers(len(_TROUSERS))],
            stride_rad=float(rng.uniform(0.3, 0.5)),
            girth=float(rng.normal(1.0, 0.08)),
            long_hair=skirt or bool(rng.random() < 0.35),
            coat=bool(rng.random() < 0.2),
            skirt=skirt,
            short_sleeves=bool(rng.random() < 0.3),
            bag=str(rng.choice(["", "backpack", "shoulder", "hand"], p=[0.5, 0.25, 0.15, 0.1])),
        )


def _any_cloth(rng: np.random.Generator) -> Rgb:
    """A linear colour of cloth: mostly muted, at times a signal colour."""
    hue = rng.uniform(0.0, 1.0)
    strength = rng.beta(1.3, 2.2)
    level = float(np.exp(rng.uniform(np.log(0.02), np.log(0.6))))
    wheel = np.clip(np.abs((hue * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    red, green, blue = level * (1.0 - strength + strength * wheel)
    return float(red), float(green), float(blue)


def _limb(root: NDArray[np.float64], lengths: tuple[float, float], angles: tuple[float, float]) -> NDArray[np.float64]:
    """Joint positions (3, 3) of a two-bone limb hanging from ``root``; angles swing forward from straight down."""
    points = [root]
    for length, angle in zip(lengths, angles, strict=True):
        points.append(points[-1] + length * np.array([np.sin(angle), np.cos(angle), 0.0]))
    return np.array(points)


def person_parts(look: PersonLook, phase: float, *, standing: bool = False) -> list[Mesh]:
    """Body parts of a 1.75 m person facing +x at a gait phase in [0, 1)."""
    swing = 0.06 if standing else look.stride_rad * np.sin(2.0 * np.pi * phase)
    girth = look.girth
    hip_y, shoulder_y = -0.92, -1.44
    parts: list[Mesh] = []
    for side, angle in ((-1.0, swing), (1.0, -swing)):
        forward = angle > 0
        lift = 0.0 if standing else max(0.0, np.cos(2.0 * np.pi * phase) * side) * 0.9
        knee_bend = 0.05 + (0.12 if forward else 0.35) * abs(angle) + 0.5 * lift
        joints = _limb(
            np.array([0.0, hip_y, side * 0.085 * girth]),
            (0.43, 0.42),
            (angle + 0.35 * lift, angle + 0.35 * lift - knee_bend),
        )
        leg_colour = look.skin if look.skirt else look.trousers
        leg_material = Material.SKIN if look.skirt else Material.CLOTH
        parts.append(
            tube(joints, np.array([0.085, 0.062, 0.045]) * girth, material=leg_material, colour=leg_colour, sides=8)
        )
        if look.shorts:
            parts.append(tube(joints[1:], np.array([0.064, 0.047]) * girth, material=Material.SKIN, colour=look.skin))
        ankle = joints[-1]
        parts.append(
            ellipsoid(
                shifted(ankle, [0.06, 0.035, 0.0]),
                (0.135, 0.045, 0.048),
                material=Material.RUBBER,
                colour=_SHOE,
                sides=8,
                rings=4,
            )
        )
        arm_root = np.array([0.0, shoulder_y + 0.04, side * 0.205 * girth])
        arm = _limb(arm_root, (0.29, 0.25), _arm_angles(look.pose, side, -0.85 * angle))
        sleeve = Material.SKIN if look.short_sleeves else Material.CLOTH
        lower_colour = look.skin if look.short_sleeves else look.top
        parts.append(tube(arm[:2], np.array([0.056, 0.046]) * girth, material=Material.CLOTH, colour=look.top, sides=7))
        parts.append(tube(arm[1:], np.array([0.045, 0.034]) * girth, material=sleeve, colour=lower_colour, sides=7))
        parts.append(
            ellipsoid(
                shifted(arm[-1], [0.01, 0.04, 0.0]),
                (0.035, 0.06, 0.025),
                material=Material.SKIN,
                colour=look.skin,
                sides=6,
                rings=4,
            )
        )
        if side > 0 and look.bag == "hand":
            x, y, z = arm[-1]
            parts.append(
                box(
                    (x - 0.16, y + 0.08, z - 0.05),
                    (x + 0.16, y + 0.36, z + 0.05),
                    material=Material.CLOTH,
                    colour=(0.08, 0.05, 0.03),
                )
            )
    parts += torso_parts(look, hip_y=hip_y, lean_rad=0.04)
    if look.skirt or look.coat:
        bottom = -0.52 if look.skirt else -0.62
        colour = look.trousers if look.skirt else look.top
        parts.append(
            rounded_loft(
                [(0, bottom, 0), (0, hip_y + 0.1, 0), (0, hip_y - 0.12, 0)],
                np.array([(0.19, 0.22), (0.15, 0.185), (0.12, 0.165)]) * girth,
                material=Material.CLOTH,
                colour=colour,
            )
        )
    if look.pose == "carry":
        parts.append(box((0.2, -1.28, -0.2), (0.5, -1.0, 0.2), material=Material.MATTE, colour=(0.3, 0.2, 0.11)))
    if look.bag == "backpack":
        parts.append(box((-0.3, -1.4, -0.15), (-0.1, -0.98, 0.15), material=Material.CLOTH, colour=(0.05, 0.06, 0.1)))
    if look.bag == "shoulder":
        parts.append(box((-0.14, -1.02, 0.19), (0.16, -0.76, 0.28), material=Material.CLOTH, colour=(0.1, 0.06, 0.035)))
    return parts


def _arm_angles(pose: str, side: float, swing_rad: float) -> tuple[float, float]:
    """Angles of the upper and the lower arm, forward from straight down."""
    if pose == "phone" and side > 0:
        return 0.45, 2.55
    if pose == "pockets":
        return -0.3, 0.35
    if pose == "carry":
        return 0.15, 1.35
    if pose == "folded":
        return 0.25, 1.75
    return swing_rad, swing_rad + 0.25 + 0.25 / 0.85 * abs(swing_rad)


def torso_parts(
    look: PersonLook, *, hip_y: float, lean_rad: float, hip_x: float = 0.0, helmet: bool = False
) -> list[Mesh]:
    """Torso, neck and head above the hip, leaning forward."""
    girth = look.girth
    along = np.array([-0.06, 0.08, 0.22, 0.38, 0.49, 0.54])
    centres = np.stack([hip_x + along * np.sin(lean_rad), hip_y - along * np.cos(lean_rad), np.zeros(6)], axis=-1)
    sizes = (
        np.array([(0.115, 0.165), (0.11, 0.155), (0.115, 0.165), (0.125, 0.19), (0.105, 0.195), (0.06, 0.09)]) * girth
    )
    neck = np.array([hip_x + 0.55 * np.sin(lean_rad), hip_y - 0.55 * np.cos(lean_rad), 0.0])
    head = shifted(neck, [0.03, -0.185, 0.0])
    parts = [
        rounded_loft(centres, sizes, material=Material.CLOTH, colour=look.top),
        tube(
            [shifted(neck, [0, 0.02, 0]), shifted(neck, [0.01, -0.1, 0])],
            [0.055, 0.05],
            material=Material.SKIN,
            colour=look.skin,
            sides=7,
        ),
        ellipsoid(head, (0.095, 0.125, 0.078), material=Material.SKIN, colour=look.skin),
    ]
    if helmet:
        parts.append(
            ellipsoid(
                shifted(head, [-0.01, -0.055, 0.0]),
                (0.13, 0.09, 0.095),
                material=Material.CAR_PAINT,
                colour=(0.6, 0.6, 0.62),
            )
        )
    else:
        parts.append(
            ellipsoid(
                shifted(head, [-0.025, -0.035, 0.0]), (0.092, 0.11, 0.087), material=Material.MATTE, colour=look.hair
            )
        )
    if look.second is not None:  # a vest or a broad stripe
        chest = slice(1, 5) if look.coat else slice(2, 4)
        parts.append(rounded_loft(centres[chest], 1.04 * sizes[chest], material=Material.CLOTH, colour=look.second))
    parts += _headgear(look, head)
    if look.long_hair:
        parts.append(
            ellipsoid(
                shifted(head, [-0.065, 0.07, 0.0]), (0.05, 0.15, 0.085), material=Material.MATTE, colour=look.hair
            )
        )
    return parts


def _headgear(look: PersonLook, head: NDArray[np.float64]) -> list[Mesh]:
    colour = look.second or look.top
    if look.hat == "cap":
        crown = ellipsoid(shifted(head, [-0.01, -0.06, 0]), (0.105, 0.08, 0.09), material=Material.CLOTH, colour=colour)
        peak = box(shifted(head, [0.07, -0.06, -0.06]), shifted(head, [0.17, -0.04, 0.06]), material=Material.CLOTH,
                   colour=colour)  # fmt: skip
        return [crown, peak]
    if look.hat == "hood":
        at = shifted(head, [-0.03, 0.0, 0])
        return [ellipsoid(at, (0.108, 0.145, 0.105), material=Material.CLOTH, colour=colour)]
    if look.hat == "brim":
        crown = ellipsoid(shifted(head, [0, -0.07, 0]), (0.1, 0.09, 0.09), material=Material.CLOTH, colour=colour)
        brim = ellipsoid(shifted(head, [0, -0.05, 0]), (0.17, 0.018, 0.16), material=Material.CLOTH, colour=colour)
        return [crown, brim]
    return []


def build_person(look: PersonLook, phase: float, *, standing: bool = False) -> Mesh:
    """A person at a gait phase, natural extent, standing on y = 0."""
    mesh = join(person_parts(look, phase, standing=standing))
    size = mesh.positions.max(axis=0) - mesh.positions.min(axis=0)
    return fitted(mesh, (size[1], size[2], size[0]))
