"""The road's centre line, its height, and its cross-section.

Road coordinates (s, t): s metres along the ego lane's centre line, t metres to the right of it. Height is world y,
positive down.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
_SAMPLE_M = 1.0


@dataclass(frozen=True, slots=True)
class Road:
    """A sampled curve.

    Attributes:
        first_s_m: s of the first sample; samples follow every metre.
        points: (N, 2) world x and z of the ego lane's centre.
        heading_rad: (N,) angle from +z towards +x.
        height_m: (N,) world y of the carriageway.
    """

    first_s_m: float
    points: FloatArray
    heading_rad: FloatArray
    height_m: FloatArray

    @property
    def last_s_m(self) -> float:
        """s of the last sample."""
        return self.first_s_m + _SAMPLE_M * (len(self.points) - 1)

    def _at(self, s: FloatArray, values: FloatArray) -> FloatArray:
        knots = self.first_s_m + _SAMPLE_M * np.arange(len(values))
        return np.interp(s, knots, values)

    def to_world(self, s: FloatArray, t: FloatArray) -> tuple[FloatArray, FloatArray]:
        """World x and z of road coordinates (broadcast)."""
        s, t = np.broadcast_arrays(np.asarray(s, dtype=np.float64), np.asarray(t, dtype=np.float64))
        heading = self._at(s, self.heading_rad)
        x = self._at(s, self.points[:, 0]) + t * np.cos(heading)
        z = self._at(s, self.points[:, 1]) - t * np.sin(heading)
        return x, z

    def point(self, s: float, t: float) -> tuple[float, float]:
        """World x and z of one point: `to_world` in plain floats."""
        place = min(max((s - self.first_s_m) / _SAMPLE_M, 0.0), len(self.points) - 1.0)
        index = min(int(place), len(self.points) - 2)
        share = place - index
        (x0, z0), (x1, z1) = self.points[index], self.points[index + 1]
        heading = float(self.heading_rad[index]) * (1.0 - share) + float(self.heading_rad[index + 1]) * share
        x = x0 + (x1 - x0) * share + t * math.cos(heading)
        z = z0 + (z1 - z0) * share - t * math.sin(heading)
        return float(x), float(z)

    def to_road(self, x: float, z: float) -> tuple[float, float]:
        """Road coordinates of one world point: nearest sample, refined along its tangent."""
        offset = np.array([x, z]) - self.points
        index = int(np.argmin((offset**2).sum(axis=1)))
        heading = self.heading_rad[index]
        ahead = offset[index, 0] * np.sin(heading) + offset[index, 1] * np.cos(heading)
        right = offset[index, 0] * np.cos(heading) - offset[index, 1] * np.sin(heading)
        return self.first_s_m + _SAMPLE_M * index + float(ahead), float(right)

    def heading_at(self, s: float | FloatArray) -> FloatArray:
        """Angle from +z towards +x."""
        return self._at(np.asarray(s, dtype=np.float64), self.heading_rad)

    def height_at(self, s: float | FloatArray) -> FloatArray:
        """World y of the carriageway."""
        return self._at(np.asarray(s, dtype=np.float64), self.height_m)


def curve(
    *,
    curvature_per_m: FloatArray,
    first_s_m: float,
    heading_at_zero_rad: float,
    offset_at_zero_m: float,
    height_m: FloatArray,
) -> Road:
    """Integrate a curvature profile (one value a metre) so that s = 0 lies beside the world's origin.

    Args:
        curvature_per_m: (N,) positive bends right.
        first_s_m: s of the first value.
        heading_at_zero_rad: direction of the road at s = 0.
        offset_at_zero_m: world x of the ego lane's centre at s = 0.
        height_m: (N,) world y.
    """
    heading = np.cumsum(curvature_per_m) * _SAMPLE_M
    zero = round(-first_s_m / _SAMPLE_M)
    heading = heading - heading[zero] + heading_at_zero_rad
    steps = _SAMPLE_M * np.stack([np.sin(heading), np.cos(heading)], axis=-1)
    points = np.cumsum(steps, axis=0)
    points = points - points[zero] + np.array([offset_at_zero_m, 0.0])
    return Road(first_s_m, points, heading, height_m)


@dataclass(frozen=True, slots=True)
class Street:
    """What kind of street lies along the road; offsets t are derived from its parts.

    Attributes:
        kind: city, residential, road, forest, campus.
        lane_m: lane width.
        lanes_right, lanes_left: extra lanes beside the ego lane; left ones carry oncoming traffic.
        parking_right, parking_left: rows of parked cars at the road's edges.
        kerb_m: height of the kerb (0: no kerb).
        pavement_m: width of the pavement (0: none).
        verge_m: width of the grass strip between carriageway and pavement.
        marked: lane markings exist.
    """

    kind: str
    lane_m: float
    lanes_right: int = 0
    lanes_left: int = 1
    parking_right: bool = False
    parking_left: bool = False
    kerb_m: float = 0.1
    pavement_m: float = 2.5
    verge_m: float = 0.0
    marked: bool = True
    parking_m: float = 2.1
    junction_s_m: tuple[float, ...] = field(default=())
    junction_half_m: float = 4.0

    @property
    def right_edge_m(self) -> float:
        """t of the carriageway's right edge, parking included."""
        return self.lane_m * (0.5 + self.lanes_right) + (self.parking_m if self.parking_right else 0.0)

    @property
    def left_edge_m(self) -> float:
        """t of the carriageway's left edge (negative), parking included."""
        return -self.lane_m * (0.5 + self.lanes_left) - (self.parking_m if self.parking_left else 0.0)

    def lane_centres(self) -> list[tuple[float, bool]]:
        """(t, same direction as the ego car) of every lane."""
        right = [(self.lane_m * index, True) for index in range(self.lanes_right + 1)]
        return right + [(-self.lane_m * (index + 1), False) for index in range(self.lanes_left)]

    def parked_rows(self) -> list[tuple[float, bool]]:
        """(t, mostly facing along the ego direction) of every row of parked cars."""
        rows = []
        if self.parking_right:
            rows.append((self.right_edge_m - 0.5 * self.parking_m, True))
        if self.parking_left:
            rows.append((self.left_edge_m + 0.5 * self.parking_m, False))
        return rows

    def raised_at(self, s: float, t: float) -> float:
        """How far the ground at (s, t) lies above the carriageway, metres."""
        inside = self.left_edge_m - 0.05 <= t <= self.right_edge_m + 0.05
        junction = any(abs(s - centre) < self.junction_half_m for centre in self.junction_s_m)
        return 0.0 if inside or junction else self.kerb_m
