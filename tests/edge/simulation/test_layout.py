"""Where objects are put: nothing overlaps, seeds repeat, counts sweep the statistics."""

from __future__ import annotations

import numpy as np
import pytest
from shapely.geometry import Polygon

from edge.simulation.drafts import AS_LABELLED, Mix, draw_counts
from edge.simulation.label_statistics import CLASSES, crowd_of, train_statistics
from edge.simulation.layout import Layout, lay_out
from edge.simulation.placing import Footprint
from edge.simulation.rig import kitti_rig
from edge.simulation.road import curve
from edge.simulation.visibility import Outlines

RIG = kitti_rig()
INTRINSICS = np.array(RIG.P2[:, :3])
SEEDS = range(40_000, 40_012)
COUNT_TOLERANCE = 0.10  # relative; half of what the data set may deviate; measured 0.09 for the rarest class
ROAD_TOLERANCE_M = 0.05  # the curve is sampled every metre
SHARE_TOLERANCE = 0.04  # a window of 40 px


def test_a_lone_outline_is_fully_seen() -> None:
    outlines = Outlines(INTRINSICS, RIG.image_size_wh, 1.65)
    pieces = [np.array([[-1.0, 0, 10], [1, 0, 10], [1, -1.5, 10], [-1, -1.5, 10]])]
    hulls, box, distance = outlines.project(pieces)
    outlines.hulls, outlines.boxes, outlines.distances = [hulls], [box], [distance]
    assert outlines.visible_share(0) == 1.0
    assert outlines.truncation(box) == 0.0


def test_half_covered_outline_and_truncation() -> None:
    outlines = Outlines(INTRINSICS, RIG.image_size_wh, 1.65)
    square = np.array([[-1.0, 0, 20], [1, 0, 20], [1, -1.6, 20], [-1, -1.6, 20]])
    nearer = np.array([[0.0, 0.3, 10], [2, 0.3, 10], [2, -2, 10], [0, -2, 10]])  # covers what is right of the middle
    for pieces in (square, nearer):
        hulls, box, distance = outlines.project([pieces])
        outlines.hulls.append(hulls)
        outlines.boxes.append(box)
        outlines.distances.append(distance)
    assert outlines.visible_share(0) == pytest.approx(0.5, abs=SHARE_TOLERANCE)
    assert outlines.visible_share(1) == 1.0
    width = RIG.image_size_wh[0]
    assert outlines.truncation(np.array([width - 30.0, 10, width + 10.0, 50])) == pytest.approx(0.25)


def test_footprints_agree_with_shapely() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        pair = [
            Footprint(
                *rng.uniform(-3, 3, 2), rng.uniform(-4, 4), length_m=rng.uniform(0.5, 5), width_m=rng.uniform(0.5, 2)
            )
            for _ in range(2)
        ]
        expected = Polygon(pair[0].corners()).intersects(Polygon(pair[1].corners()))
        assert pair[0].overlaps(pair[1]) == expected


def test_road_coordinates_invert() -> None:
    road = curve(
        curvature_per_m=np.full(121, 1 / 300), first_s_m=-20.0, heading_at_zero_rad=0.02, offset_at_zero_m=0.3,
        height_m=np.zeros(121),
    )  # fmt: skip
    assert road.point(0.0, 0.0) == pytest.approx((0.3, 0.0))
    for s, t in ((0.0, 2.0), (37.4, -6.0), (80.2, 11.0)):
        x, z = road.point(s, t)
        assert (x, z) == pytest.approx(tuple(float(value) for value in road.to_world(s, t)))
        assert road.to_road(x, z) == pytest.approx((s, t), abs=ROAD_TOLERANCE_M)


def test_same_seed_same_layout_and_other_seed_another() -> None:
    first, again, other = (
        lay_out(seed, intrinsics=INTRINSICS, size_wh=RIG.image_size_wh) for seed in (40_100, 40_100, 40_101)
    )
    assert first.objects == again.objects
    assert first.objects != other.objects


def test_objects_do_not_overlap_and_stand_before_the_camera() -> None:
    for seed in SEEDS:
        layout = lay_out(seed, intrinsics=INTRINSICS, size_wh=RIG.image_size_wh)
        bases = [
            Polygon(
                Footprint(
                    o.location[0], o.location[2], o.yaw_rad, length_m=o.size_hwl[2], width_m=o.size_hwl[1]
                ).corners()
            )
            for o in layout.objects
        ]
        assert all(not a.intersects(b) for i, a in enumerate(bases) for b in bases[:i])
        assert len({o.object_id for o in layout.objects}) == len(layout.objects)


def test_counts_of_seeds_in_a_row_follow_the_statistics() -> None:
    cells = np.array(train_statistics()["counts"])
    expected = (cells[:, :-1] * cells[:, -1:]).sum(axis=0) / cells[:, -1].sum()
    for start in (0, 1_000_000):
        found = np.mean([draw_counts(seed) for seed in range(start, start + 500)], axis=0)
        assert found == pytest.approx(expected, rel=COUNT_TOLERANCE), CLASSES


def test_crowd_buckets() -> None:
    assert crowd_of(np.array([0, 2, 3, 8, 9, 40])).tolist() == [0, 0, 1, 2, 3, 4]


def test_a_mix_shows_people_oftener_and_leaves_the_rest_in_proportion() -> None:
    table = np.array(train_statistics()["counts"])
    people = table[:, 3:5].sum(axis=1) > 0
    weight = table[:, -1] * np.where(people, 3.0, 1.0)
    found = np.array([draw_counts(seed, Mix(people=3.0)) for seed in range(500)])
    with_people = found[:, 3:].sum(axis=1) > 0
    assert with_people.mean() == pytest.approx(weight[people].sum() / weight.sum(), rel=COUNT_TOLERANCE)
    for rows, wanted in ((with_people, people), (~with_people, ~people)):  # cars among their own kind of frame
        expected = (table[wanted, 0] * table[wanted, -1]).sum() / table[wanted, -1].sum()
        assert found[rows, 0].mean() == pytest.approx(expected, rel=COUNT_TOLERANCE)


def test_a_mix_brings_more_objects_near() -> None:
    depths = [[o.location[2] for seed in SEEDS for o in _laid_out(seed, Mix(near=near)).objects] for near in (1.0, 4.0)]
    shares = [np.mean(np.array(values) < 10.0) for values in depths]
    assert shares[1] > 1.5 * shares[0]
    assert _laid_out(SEEDS[0], Mix()).objects == _laid_out(SEEDS[0], AS_LABELLED).objects


def _laid_out(seed: int, mix: Mix) -> Layout:
    return lay_out(seed, intrinsics=INTRINSICS, size_wh=RIG.image_size_wh, mix=mix)
