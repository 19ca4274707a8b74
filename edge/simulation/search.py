"""Where the objects of a frame stand: drawn from the statistics, revised until each is hidden and cut as drafted."""

from __future__ import annotations

import numpy as np

from edge.simulation.drafts import Draft, label_tables
from edge.simulation.label_statistics import (
    DEPTH_BAND_EDGES_M,
    HEADING_BINS,
    LATERAL_STEP_M,
    TRUNCATION_EDGES,
)
from edge.simulation.placing import Footprint, silhouette_points
from edge.simulation.road import Road, Street
from edge.simulation.visibility import Outlines

VEHICLES = ("Car", "Van", "Truck")
_VISIBLE_RANGE = ((0.82, 1.0), (0.40, 0.73), (0.12, 0.34))  # wanted share seen, by occlusion level
_PARALLEL_RAD, _CROSSING_RAD = 0.40, 1.17
_EGO = Footprint(0.0, 0.1, -0.5 * np.pi, length_m=6.2, width_m=2.2)


class Search:
    """Positions of a frame's objects, revised by accepted random moves."""

    def __init__(self, road: Road, street: Street, outlines: Outlines, rng: np.random.Generator) -> None:
        self._road, self._street, self._outlines, self._rng = road, street, outlines, rng
        self.drafts: list[Draft] = []
        self._cost: list[float] = []

    def insert(self, draft: Draft, tries: int = 40) -> None:
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

    def _base(self, draft: Draft) -> Footprint:
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

    def _nudge(self, draft: Draft) -> None:
        near, far = draft.depth_range_m
        draft.s = float(np.clip(draft.s + self._rng.normal(0.0, 1.2), near, far))
        if draft.kind not in VEHICLES:
            draft.t += float(self._rng.normal(0.0, 0.8))

    def _propose(self, draft: Draft) -> None:
        """A random place and heading at the draft's depth, pulled into the street's order."""
        rng = self._rng
        depth = float(rng.uniform(*draft.depth_range_m))
        placement = label_tables()[draft.kind][1]
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

    def _order_vehicle(self, draft: Draft, turn: float) -> float:
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

    def _order_person(self, draft: Draft) -> None:
        street, rng = self._street, self._rng
        if draft.kind == "Cyclist" or street.pavement_m == 0.0 or street.kind == "campus":
            return
        inside = street.left_edge_m < draft.t < street.right_edge_m
        if inside and rng.random() < 0.55:
            outside = rng.uniform(0.4, street.verge_m + street.pavement_m)
            right = draft.t - street.left_edge_m > street.right_edge_m - draft.t
            draft.t = float(street.right_edge_m + outside if right else street.left_edge_m - outside)
