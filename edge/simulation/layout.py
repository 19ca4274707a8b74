"""Single frames: a street with objects laid out so that many frames together follow the label statistics.

A frame draws how many objects of each class it holds, and for each object a depth bin, an occlusion level and a
truncation bin that go together in real labels. Positions and headings come from the placement statistics, are pulled
into lanes, parked rows and pavements, and are then revised until each object is hidden and cut off about as much as it
was meant to be. Nothing overlaps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge.simulation.label_statistics import (
    CLASSES,
    DEPTH_BAND_EDGES_M,
    DEPTH_STEP_M,
    HEADING_BINS,
    LATERAL_STEP_M,
    TRUNCATION_EDGES,
    crowd_of,
    train_statistics,
)
from edge.simulation.placing import (
    Footprint,
    PlacedObject,
    choose_body,
    draw_size,
    draw_tint,
    silhouette_points,
)
from edge.simulation.road import Road, Street, curve
from edge.simulation.visibility import Outlines
from runtime.contracts.objects import wrap_angle_rad

FloatArray = NDArray[np.float64]
VEHICLES = ("Car", "Van", "Truck")
_PEOPLE = [CLASSES.index("Pedestrian"), CLASSES.index("Cyclist")]
_NEAR_M = 10.0
ROAD_BEHIND_M, ROAD_AHEAD_M = 20, 170
_GOLDEN = 0.6180339887498949
_VISIBLE_RANGE = ((0.82, 1.0), (0.40, 0.73), (0.12, 0.34))  # wanted share seen, by occlusion level
_OCCLUSION_TILT = (1.0, 1.25, 1.1)  # some wanted occlusions cannot be arranged: ask for more of them
_SMALLEST_LABEL_PX = 17.5
_PARALLEL_RAD, _CROSSING_RAD = 0.40, 1.17
_EGO = Footprint(0.0, 0.1, -0.5 * np.pi, length_m=6.2, width_m=2.2)


@dataclass(frozen=True, slots=True)
class Layout:
    """A frame's world without its scenery."""

    road: Road
    street: Street
    camera_height_m: float
    objects: tuple[PlacedObject, ...]
    screens: tuple[tuple[int, float], ...]  # (object index, share of it that scenery should hide)


@dataclass(frozen=True, slots=True)
class Mix:
    """How much oftener than in KITTI's labels a set of frames shows something; all 1: as often.

    Attributes:
        people: factor on frames that hold pedestrians or cyclists.
        near: factor on objects within 10 m, whole or cut by the picture's edge.
    """

    people: float = 1.0
    near: float = 1.0


AS_LABELLED = Mix()


@dataclass(slots=True)
class _Draft:
    """An object while positions are still being revised."""

    kind: str
    size_hwl: tuple[float, float, float]
    depth_range_m: tuple[float, float]
    occlusion: int
    truncation_bin: int
    s: float = 0.0
    t: float = 0.0
    yaw_rad: float = 0.0
    base: Footprint | None = None


@lru_cache(maxsize=1)
def _tables() -> dict[str, Any]:
    """The statistics as arrays; counts ordered so that neighbouring entries are alike."""
    statistics = train_statistics()
    counts = np.array(sorted(statistics["counts"], key=lambda row: (sum(row[3:5]) > 0, sum(row[:3]), row)))
    tables: dict[str, Any] = {
        "statistics": statistics,
        "counts": counts[:, :-1],
        "count_weights": counts[:, -1],
    }
    for name in CLASSES:
        entry = statistics["classes"][name]
        tables[name] = (np.array(entry["appearance"]), np.array(entry["placement"]))
    return tables


def draw_counts(seed: int, mix: Mix = AS_LABELLED) -> NDArray[np.int64]:
    """Objects of each of `CLASSES` in the frame of a seed; seeds in a row sweep the distribution evenly."""
    tables = _tables()
    position = (seed * _GOLDEN) % 1.0
    with_people = tables["counts"][:, _PEOPLE].sum(axis=1) > 0
    summed = np.cumsum(tables["count_weights"] * np.where(with_people, mix.people, 1.0))
    row = min(int(np.searchsorted(summed / summed[-1], position)), len(tables["counts"]) - 1)
    counts: NDArray[np.int64] = tables["counts"][row]
    return counts


def draw_street(rng: np.random.Generator, *, vehicles: int, people: int) -> Street:
    """A street that suits the number of vehicles and people."""
    if people >= 4:
        shares = {"city": 0.5, "campus": 0.4, "residential": 0.1}
    elif vehicles >= 6:
        shares = {"residential": 0.5, "city": 0.38, "road": 0.12}
    elif vehicles + people >= 3:
        shares = {"residential": 0.3, "city": 0.35, "road": 0.25, "forest": 0.1}
    else:
        shares = {"residential": 0.2, "city": 0.2, "road": 0.3, "forest": 0.2, "campus": 0.1}
    kind = str(rng.choice(list(shares), p=list(shares.values())))
    crowded = vehicles >= 5
    if kind == "residential":
        lane = float(rng.uniform(2.5, 3.1))
        return Street(
            kind,
            lane,
            parking_right=bool(rng.random() < 0.8),
            parking_left=bool(rng.random() < 0.8),
            marked=bool(rng.random() < 0.15),
            pavement_m=float(rng.uniform(1.5, 2.5)),
            verge_m=float(rng.choice([0.0, 0.0, 1.2])),
        )
    if kind == "city":
        return Street(
            kind,
            float(rng.uniform(2.9, 3.5)),
            lanes_right=int(rng.random() < 0.25),
            lanes_left=1 + int(rng.random() < 0.25),
            parking_right=bool(rng.random() < (0.75 if crowded else 0.4)),
            parking_left=bool(rng.random() < (0.75 if crowded else 0.4)),
            pavement_m=float(rng.uniform(2.0, 4.0)),
            verge_m=float(rng.choice([0.0, 0.0, 1.5, 2.5])),
            marked=bool(rng.random() < 0.7),
        )
    if kind == "campus":
        return Street(
            kind,
            float(rng.uniform(2.6, 3.2)),
            kerb_m=0.02,
            pavement_m=float(rng.uniform(3.0, 8.0)),
            marked=False,
            parking_right=bool(rng.random() < 0.25),
        )
    if kind == "forest":
        return Street(kind, float(rng.uniform(3.0, 3.6)), kerb_m=0.0, pavement_m=0.0, verge_m=3.0)
    return Street(
        kind,
        float(rng.uniform(3.2, 3.7)),
        lanes_right=int(rng.random() < 0.4),
        lanes_left=1 + int(rng.random() < 0.4),
        kerb_m=float(rng.choice([0.0, 0.1])),
        pavement_m=float(rng.choice([0.0, 2.0])),
        verge_m=float(rng.uniform(1.0, 4.0)),
        parking_right=bool(crowded and rng.random() < 0.5),
        parking_left=bool(crowded and rng.random() < 0.5),
    )


def draw_road(rng: np.random.Generator, street: Street) -> Road:
    """A straight or gently bent road through the ego car, rising or falling a little."""
    count = ROAD_BEHIND_M + ROAD_AHEAD_M + 1
    tightest = {"city": 1 / 400, "residential": 1 / 250, "campus": 1 / 200, "forest": 1 / 350, "road": 1 / 450}[
        street.kind
    ]
    bend = 0.0 if rng.random() < 0.45 else rng.normal(0.0, tightest)
    curvature = np.full(count, bend)
    curvature[ROAD_BEHIND_M + 25 :] += rng.normal(0.0, 0.5 * tightest)
    s = np.arange(-ROAD_BEHIND_M, ROAD_AHEAD_M + 1.0)
    slope, reach = rng.normal(0.0015, 0.012), 45.0
    height = slope * reach * (1.0 - np.exp(-np.maximum(s, -40.0) / reach)) * np.where(s > 0, 1.0, 0.5)
    return curve(
        curvature_per_m=curvature,
        first_s_m=-float(ROAD_BEHIND_M),
        heading_at_zero_rad=float(rng.normal(0.0, 0.02)),
        offset_at_zero_m=float(rng.normal(0.0, 0.2)),
        height_m=height,
    )


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
    drafts = _draw_drafts(counts, rng, focal_px=float(intrinsics[1, 1]), near=mix.near)
    search = _Search(road, street, Outlines(intrinsics, size_wh, camera_height_m), rng)
    for draft in sorted(drafts, key=lambda item: item.depth_range_m[0]):
        search.insert(draft)
    search.revise()
    objects = [
        _finish(draft, index + 1, road=road, street=street, rng=rng) for index, draft in enumerate(search.drafts)
    ]
    screens = search.unhidden()
    objects += _far_traffic(road, street, rng, first_id=len(objects) + 1)
    return Layout(road, street, camera_height_m, tuple(objects), tuple(screens))


def _draw_drafts(counts: NDArray[np.int64], rng: np.random.Generator, *, focal_px: float, near: float) -> list[_Draft]:
    tables = _tables()
    crowd = int(crowd_of(int(counts.sum())))
    drafts = []
    for name, count in zip(CLASSES, counts, strict=True):
        appearance = tables[name][0]
        rows = appearance[appearance[:, 0] == crowd]
        rows = rows if rows[:, -1].sum() >= 20 else appearance
        weights = rows[:, -1] * np.array(_OCCLUSION_TILT)[rows[:, 2]]
        weights = weights * np.where((rows[:, 1] + 1) * DEPTH_STEP_M <= _NEAR_M, near, 1.0)
        weights = weights / weights.sum()
        for _ in range(int(count)):
            size = draw_size(name, tables["statistics"], rng)
            farthest_m = focal_px * size[0] / _SMALLEST_LABEL_PX
            _, depth_bin, occlusion, truncation, _ = rows[int(rng.choice(len(rows), p=weights))]
            far = min((depth_bin + 1) * DEPTH_STEP_M, farthest_m)  # what would be too small for a label comes nearer
            first = max(min(depth_bin * DEPTH_STEP_M, far - DEPTH_STEP_M), 1.0)
            drafts.append(
                _Draft(name, size, (float(first), float(max(far, first + 0.1))), int(occlusion), int(truncation))
            )
    return drafts


def _finish(draft: _Draft, object_id: int, *, road: Road, street: Street, rng: np.random.Generator) -> PlacedObject:
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
        draft = _Draft("Car", draw_size("Car", _tables()["statistics"], rng), (92.0, 140.0), 0, 0)
        draft.s, draft.t = 95.0 + 16.0 * index + float(rng.uniform(0.0, 10.0)), t
        draft.yaw_rad = float(road.heading_at(draft.s)) - 0.5 * np.pi + (0.0 if along else np.pi)
        found.append(_finish(draft, first_id + index, road=road, street=street, rng=rng))
    return found


class _Search:
    """Positions of a frame's objects, revised by accepted random moves."""

    def __init__(self, road: Road, street: Street, outlines: Outlines, rng: np.random.Generator) -> None:
        self._road, self._street, self._outlines, self._rng = road, street, outlines, rng
        self.drafts: list[_Draft] = []
        self._cost: list[float] = []

    def insert(self, draft: _Draft, tries: int = 40) -> None:
        """Add an object at the best of a few random places; left out if nothing is free."""
        index = len(self.drafts)
        best: tuple[float, tuple[float, float, float]] | None = None
        self.drafts.append(draft)
        for values in (self._outlines.hulls, self._outlines.boxes, self._outlines.distances):
            values.append(None)  # type: ignore[arg-type]
        self._cost.append(0.0)
        for _ in range(tries):
            self._propose(draft)
            if not self._free(index):
                continue
            self._project(index)
            cost = self._cost_of(index)
            if best is None or cost < best[0]:
                best = cost, (draft.s, draft.t, draft.yaw_rad)
            if cost == 0.0:
                break
        if best is None:
            for values in (
                self.drafts,
                self._outlines.hulls,
                self._outlines.boxes,
                self._outlines.distances,
                self._cost,
            ):
                values.pop()  # type: ignore[attr-defined]
            return
        self._set(index, best[1])
        self._refresh(range(len(self.drafts)))

    def revise(self, rounds_per_object: int = 32) -> None:
        """Move objects about while that brings the frame nearer to what was drawn."""
        temperature = 0.05
        for step in range(rounds_per_object * len(self.drafts)):
            total = sum(self._cost)
            if total < 0.05:
                break
            index = self._pick(step)
            draft = self.drafts[index]
            before = (draft.s, draft.t, draft.yaw_rad)
            old_box = self._outlines.boxes[index]
            if self._rng.random() < 0.3:
                self._nudge(draft)
            else:
                self._propose(draft)
            if not self._free(index):
                self._restore(index, before)
                continue
            saved = (self._outlines.hulls[index], old_box, self._outlines.distances[index])
            self._project(index)
            touched = sorted({index, *self._outlines.touched_by(old_box, self._outlines.boxes[index])})
            costs = {other: self._cost_of(other) for other in touched}
            change = sum(costs.values()) - sum(self._cost[other] for other in touched)
            if change <= 0.0 or self._rng.random() < np.exp(-change / temperature):
                for other, cost in costs.items():
                    self._cost[other] = cost
            else:
                self._restore(index, before)
                self._outlines.hulls[index], self._outlines.boxes[index], self._outlines.distances[index] = saved

    def unhidden(self) -> list[tuple[int, float]]:
        """Objects that other objects hide less than was drawn, and the share that is still to be hidden."""
        found = []
        for index, draft in enumerate(self.drafts):
            low, high = _VISIBLE_RANGE[draft.occlusion]
            seen = self._outlines.visible_share(index)
            if seen > high + 0.03:
                found.append((index, float(1.0 - self._rng.uniform(low, high) / seen)))
        return found

    def _pick(self, step: int) -> int:
        costs = np.array(self._cost)
        if step % 3 and costs.sum() > 0:
            return int(self._rng.choice(len(costs), p=costs / costs.sum()))
        return int(self._rng.integers(len(costs)))

    def _restore(self, index: int, pose: tuple[float, float, float]) -> None:
        draft = self.drafts[index]
        draft.s, draft.t, draft.yaw_rad = pose
        draft.base = self._base(draft)

    def _set(self, index: int, pose: tuple[float, float, float]) -> None:
        self._restore(index, pose)
        self._project(index)

    def _refresh(self, indices: range) -> None:
        for index in indices:
            self._cost[index] = self._cost_of(index)

    def _base(self, draft: _Draft) -> Footprint:
        x, z = self._road.point(draft.s, draft.t)
        gap = 0.5 if draft.kind in VEHICLES else 0.2
        return Footprint(
            float(x), float(z), draft.yaw_rad, length_m=draft.size_hwl[2] + gap, width_m=draft.size_hwl[1] + gap
        )

    def _free(self, index: int) -> bool:
        draft = self.drafts[index]
        base = draft.base = self._base(draft)
        if base.overlaps(_EGO):
            return False
        for other, neighbour in enumerate(self.drafts):
            if other == index or neighbour.base is None:
                continue
            if base.overlaps(neighbour.base):
                return False
        return True

    def _project(self, index: int) -> None:
        draft = self.drafts[index]
        x, z = self._road.point(draft.s, draft.t)
        location = np.array([x, float(self._road.height_at(draft.s)), z])
        points = silhouette_points(draft.kind, draft.size_hwl, location, draft.yaw_rad)
        hull, box, distance = self._outlines.project(points)
        self._outlines.hulls[index], self._outlines.boxes[index], self._outlines.distances[index] = hull, box, distance

    def _cost_of(self, index: int) -> float:
        draft = self.drafts[index]
        truncation = self._outlines.truncation(self._outlines.boxes[index])
        found_bin = int(np.digitize(truncation, TRUNCATION_EDGES)) - 1
        cost = 0.6 * abs(found_bin - draft.truncation_bin)
        if truncation > 0.85:
            cost += 4.0 * (truncation - 0.85) + 1.0
        seen = self._outlines.visible_share(index)
        low, high = _VISIBLE_RANGE[draft.occlusion]
        cost += 4.0 * max(low - seen, seen - high, 0.0) + (0.4 if seen < low or seen > high else 0.0)
        if seen < 0.11:
            cost += 2.0
        return cost

    def _nudge(self, draft: _Draft) -> None:
        near, far = draft.depth_range_m
        draft.s = float(np.clip(draft.s + self._rng.normal(0.0, 1.2), near, far))
        if draft.kind not in VEHICLES:
            draft.t += float(self._rng.normal(0.0, 0.8))

    def _propose(self, draft: _Draft) -> None:
        """A random place and heading at the draft's depth, pulled into the street's order."""
        rng = self._rng
        depth = float(rng.uniform(*draft.depth_range_m))
        placement = _tables()[draft.kind][1]
        band = int(np.digitize(depth, DEPTH_BAND_EDGES_M)) - 1
        rows = placement[placement[:, 0] == band]
        if len(rows) == 0:
            rows = placement
        weights = rows[:, -1] / rows[:, -1].sum()
        _, lateral, heading, _ = rows[int(rng.choice(len(rows), p=weights))]
        draft.s = depth
        draft.t = float((lateral + rng.uniform(-0.5, 0.5)) * LATERAL_STEP_M)
        turn = float(
            (heading + rng.uniform(-0.5, 0.5)) * (2 * np.pi / HEADING_BINS) + 0.5 * np.pi
        )  # from the road's direction
        if draft.kind in VEHICLES:
            turn = self._order_vehicle(draft, turn)
        else:
            self._order_person(draft)
        draft.yaw_rad = float(self._road.heading_at(draft.s)) - 0.5 * np.pi + turn

    def _order_vehicle(self, draft: _Draft, turn: float) -> float:
        """Pull a vehicle into a lane, a parked row, a crossing street or a lot; returns its turn from the road."""
        rng, street = self._rng, self._street
        along = float(np.cos(turn))
        if abs(along) > np.cos(_PARALLEL_RAD):
            forward = along > 0
            rows = [(t, same, True) for t, same in street.lane_centres()] + [
                (t, same, False) for t, same in street.parked_rows()
            ]
            suited = [row for row in rows if not row[2] or row[1] == forward]
            t, _, moving = min(suited, key=lambda row: abs(row[0] - draft.t))
            snapped = abs(t - draft.t) < 2.2 or street.left_edge_m - 0.8 < draft.t < street.right_edge_m + 0.8
            if snapped:
                draft.t = t + float(rng.normal(0.0, 0.22 if moving else 0.12))
            straight = 0.0 if forward else np.pi
            return straight + float(rng.normal(0.0, 0.015 if moving else 0.03))
        half = 0.5 * draft.size_hwl[2] + 0.3
        if abs(along) < np.cos(_CROSSING_RAD):
            for centre in street.junction_s_m:
                if abs(draft.s - centre) < 10.0 and draft.depth_range_m[0] - 3 < centre < draft.depth_range_m[1] + 3:
                    draft.s = centre + (-1.6 if np.sin(turn) > 0 else 1.6)
                    return float(np.sign(np.sin(turn)) * 0.5 * np.pi + rng.normal(0.0, 0.03))
            turn = float(np.sign(np.sin(turn)) * 0.5 * np.pi + rng.normal(0.0, 0.04))
        reach = half * abs(np.sin(turn)) + 0.5 * draft.size_hwl[1] * abs(np.cos(turn))
        if draft.t >= 0.5 * (street.left_edge_m + street.right_edge_m):
            draft.t = max(draft.t, street.right_edge_m + reach)
        else:
            draft.t = min(draft.t, street.left_edge_m - reach)
        return turn

    def _order_person(self, draft: _Draft) -> None:
        street, rng = self._street, self._rng
        if draft.kind == "Cyclist" or street.pavement_m == 0.0 or street.kind == "campus":
            return
        inside = street.left_edge_m < draft.t < street.right_edge_m
        if inside and rng.random() < 0.55:
            outside = rng.uniform(0.4, street.verge_m + street.pavement_m)
            right = draft.t - street.left_edge_m > street.right_edge_m - draft.t
            draft.t = float(street.right_edge_m + outside if right else street.left_edge_m - outside)
