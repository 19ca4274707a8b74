"""Single frames: a street with objects laid out so that many frames together follow the label statistics.

A frame draws how many objects of each class it holds, and for each object a depth bin, an occlusion level and a
truncation bin that go together in real labels. Positions and headings come from the placement statistics, are pulled
into lanes, parked rows and pavements, and are then revised until each object is hidden and cut off about as much as it
was meant to be. Nothing overlaps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edge.simulation.drafts import AS_LABELLED, Draft, Mix, draw_counts, draw_drafts, label_tables
from edge.simulation.placing import PlacedObject, choose_body, draw_size, draw_tint
from edge.simulation.road import Road, Street
from edge.simulation.search import Search
from edge.simulation.streets import draw_road, draw_street
from edge.simulation.visibility import Outlines
from runtime.contracts.objects import wrap_angle_rad

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Layout:
    """A frame's world without its scenery."""

    road: Road
    street: Street
    camera_height_m: float
    objects: tuple[PlacedObject, ...]
    screens: tuple[tuple[int, float], ...]  # (object index, share of it that scenery should hide)


def lay_out(seed: int, *, intrinsics: FloatArray, size_wh: tuple[int, int], mix: Mix = AS_LABELLED) -> Layout:
    """The frame of a seed as seen with a camera of the given intrinsics (3, 3)."""
    rng = np.random.default_rng([seed, 1])
    counts = draw_counts(seed, mix)
    street = draw_street(rng, vehicles=int(counts[:3].sum()), people=int(counts[3:].sum()))
    if street.kind in ("city", "residential", "road") and rng.random() < 0.35:
        street = replace(
            street, junction_s_m=(float(rng.uniform(14.0, 60.0)),), junction_half_m=float(rng.uniform(3.0, 6.0))
        )
    road = draw_road(rng, street)
    camera_height_m = float(rng.normal(1.66, 0.04))
    drafts = draw_drafts(counts, rng, focal_px=float(intrinsics[1, 1]), near=mix.near)
    search = Search(road, street, Outlines(intrinsics, size_wh, camera_height_m), rng)
    for draft in sorted(drafts, key=lambda item: item.depth_range_m[0]):
        search.insert(draft)
    search.revise()
    objects = [
        _finish(draft, index + 1, road=road, street=street, rng=rng) for index, draft in enumerate(search.drafts)
    ]
    screens = search.unhidden()
    objects += _far_traffic(road, street, rng, first_id=len(objects) + 1)
    return Layout(road, street, camera_height_m, tuple(objects), tuple(screens))


def _finish(draft: Draft, object_id: int, *, road: Road, street: Street, rng: np.random.Generator) -> PlacedObject:
    x, z = road.point(draft.s, draft.t)
    body, phase, label, own = choose_body(draft.kind, draft.size_hwl, rng)
    y = float(road.height_at(draft.s)) - street.raised_at(draft.s, draft.t)
    yaw = float(wrap_angle_rad(np.array(draft.yaw_rad)))
    return PlacedObject(
        draft.kind, body, phase, label, (float(x), y, float(z)), yaw, draw_tint(draft.kind, rng), object_id, own
    )


def _far_traffic(road: Road, street: Street, rng: np.random.Generator, *, first_id: int) -> list[PlacedObject]:
    """A few cars beyond 92 m: too far for a label."""
    found = []
    lanes = street.lane_centres()
    for index in range(int(rng.poisson(0.6))):
        t, along = lanes[int(rng.integers(len(lanes)))]
        draft = Draft("Car", draw_size("Car", label_tables()["statistics"], rng), (92.0, 140.0), 0, 0)
        draft.s, draft.t = 95.0 + 16.0 * index + float(rng.uniform(0.0, 10.0)), t
        draft.yaw_rad = float(road.heading_at(draft.s)) - 0.5 * np.pi + (0.0 if along else np.pi)
        found.append(_finish(draft, first_id + index, road=road, street=street, rng=rng))
    return found
