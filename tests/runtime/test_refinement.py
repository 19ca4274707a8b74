"""Refinement of depth: synthetic pairs whose surfaces are known exactly."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
import pytest

from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D
from runtime.refinement import RefineDepths, refine_depths, refiner

FOCAL_PX, BASELINE_M, SIZE_WH = 700.0, 0.5, (600, 240)
CLASSES = ("Car", "Pedestrian")
REAR_TO_CENTER_M = 0.92 * 2.0
SAME_SHARE = 1e-4
"""Of the depth, in which float32 sums of another order may end."""
SAME_COST = 1e-3
DEPTH_SHARE = 0.004
"""Half a hundredth of the depth, at 15 m a tenth of a pixel: what linear lookup of smooth texture leaves."""


def rig(right_offset_px: float = 0.0) -> StereoGeometry:
    P2 = np.array([[FOCAL_PX, 0.0, 300.0, 30.0], [0.0, FOCAL_PX, 120.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    P3 = P2.copy()
    P3[0, 3] -= FOCAL_PX * BASELINE_M
    P3[0, 2] += right_offset_px
    return StereoGeometry(P2, P3, SIZE_WH)


def pair(depth: np.ndarray, *, right_offset_px: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A textured wall with (W,) or (H, W) depths, seen by both cameras; the texture belongs to the left pixels."""
    noise = np.random.default_rng(5).uniform(0, 255, (SIZE_WH[1], SIZE_WH[0], 3)).astype(np.uint8)
    left = cv2.GaussianBlur(noise, (0, 0), 2.0)
    left = cv2.normalize(left, None, 0, 255, cv2.NORM_MINMAX)
    columns = np.arange(SIZE_WH[0], dtype=np.float64)
    seen_at = columns - FOCAL_PX * BASELINE_M / np.broadcast_to(depth, SIZE_WH[::-1]) + right_offset_px
    back = np.stack([np.interp(columns, row, columns) for row in seen_at])  # seen_at rises: no row hides any of itself
    rows = np.repeat(np.arange(SIZE_WH[1], dtype=np.float32)[:, None], SIZE_WH[0], axis=1)
    right = cv2.remap(left, back.astype(np.float32), rows, cv2.INTER_LINEAR)
    return left, right


def one(kind: str, depth_m: float, *, box: tuple[float, float, float, float] = (260, 60, 340, 180)) -> Detections3D:
    return Detections3D(
        class_id=[CLASSES.index(kind)],
        score=[0.9],
        box_in_left_image=[box],
        center_in_camera=[[-30.0 / FOCAL_PX, 0.0, depth_m]],
        size_hwl=[[1.7, 0.6, 0.8] if kind == "Pedestrian" else [1.5, 1.6, 4.0]],
        alpha_rad=[-np.pi / 2],
        yaw_rad=[-np.pi / 2],
        class_names=CLASSES,
    )


def wall(depth_m: float) -> np.ndarray:
    return np.full(SIZE_WH[0], depth_m)


def rear(depth_m: float, *, box_top: int = 60, box_bottom: int = 180) -> np.ndarray:
    """(H, W) depths of a car's rear, 4 m long, whose windows stand back by what the plan of its cabin is shorter."""
    belt = box_top + 0.42 * (box_bottom - box_top)
    above = np.arange(SIZE_WH[1]) < belt
    return np.repeat(np.where(above, depth_m + (0.92 - 0.7) * 2.0, depth_m)[:, None], SIZE_WH[0], axis=1)


@pytest.fixture(params=["numpy", "native"])
def refine(request: pytest.FixtureRequest) -> RefineDepths:
    """In NumPy, and by the library."""
    if request.param == "numpy":
        return refine_depths
    found = refiner()
    if found is refine_depths:
        pytest.skip("the native library is not built")
    return found


def test_nothing_found_stays_nothing(refine: RefineDepths) -> None:
    left, right = pair(wall(15.0))
    none = Detections3D.empty(CLASSES)
    assert refine(none, left, right, rig()).detections is none


@pytest.mark.parametrize("box", [(260, 60, 264, 180), (260, 60, 340, 66), (700, 60, 800, 180), (-90, -80, -5, -3)])
def test_boxes_too_small_or_outside_stay(refine: RefineDepths, box: tuple[float, float, float, float]) -> None:
    left, right = pair(wall(15.0))
    found = one("Pedestrian", 14.0, box=box)
    np.testing.assert_array_equal(refine(found, left, right, rig()).detections.center_in_camera, found.center_in_camera)


@pytest.mark.parametrize("depth_m", [175.0, 176.0, 400.0])
def test_beyond_two_pixels_of_disparity_depths_stay(refine: RefineDepths, depth_m: float) -> None:
    """Whatever stands there: a box of a far car is not pulled to the nearest depth that could be searched."""
    left, right = pair(wall(60.0))
    found = one("Pedestrian", depth_m)
    np.testing.assert_array_equal(refine(found, left, right, rig()).detections.center_in_camera, found.center_in_camera)


@pytest.mark.parametrize("depth_m", [100.0, 150.0])
def test_near_that_limit_the_search_stays_even(refine: RefineDepths, depth_m: float) -> None:
    """Flat pixels match everywhere: where nothing is seen the network's depth wins, as it does near by."""
    flat = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
    moved = refine(one("Pedestrian", depth_m), flat, flat, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(depth_m, rel=1e-6)


@pytest.mark.parametrize("start_m", [13.5, 14.5, 15.0, 16.5])
def test_a_person_goes_to_the_depth_of_the_pixels(refine: RefineDepths, start_m: float) -> None:
    left, right = pair(wall(15.0))
    moved = refine(one("Pedestrian", start_m), left, right, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(15.0, rel=DEPTH_SHARE)


def test_a_car_is_as_far_behind_its_rear_as_it_is_long(refine: RefineDepths) -> None:
    left, right = pair(rear(15.0))
    moved = refine(one("Car", 16.0), left, right, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(15.0 + REAR_TO_CENTER_M, rel=DEPTH_SHARE)


def test_exposure_of_one_view_does_not_matter(refine: RefineDepths) -> None:
    left, right = pair(wall(15.0))
    darker = (right.astype(np.float64) * 0.6 + 9.0).astype(np.uint8)
    moved = refine(one("Pedestrian", 14.0), left, darker, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(15.0, rel=DEPTH_SHARE)


def test_an_offset_of_the_right_image_that_the_projection_knows_does_not_matter(refine: RefineDepths) -> None:
    left, right = pair(wall(15.0), right_offset_px=1.5)
    told = refine(one("Pedestrian", 14.5), left, right, rig(1.5)).detections.center_in_camera[0, 2]
    untold = refine(one("Pedestrian", 14.5), left, right, rig()).detections.center_in_camera[0, 2]
    assert told == pytest.approx(15.0, rel=DEPTH_SHARE)
    assert untold > 15.8  # 1.5 of 23 px


def test_what_stands_beside_the_object_counts_little(refine: RefineDepths) -> None:
    depth = wall(15.0)
    depth[:275] = depth[325:] = 40.0
    left, right = pair(np.convolve(np.pad(depth, 2, mode="edge"), np.full(5, 0.2), mode="valid"))
    moved = refine(one("Pedestrian", 14.3), left, right, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(15.0, rel=DEPTH_SHARE)


def behind_something(hidden_from_column: int) -> tuple[np.ndarray, np.ndarray]:
    """A car's rear at 15 m, hidden from a column on by one at 12.5 m (28 px against 23: within reach of the search)."""
    depth = rear(15.0)
    depth[:, hidden_from_column:] = rear(12.5)[:, hidden_from_column:]
    return pair(cv2.blur(depth, (5, 1)))


def both(hidden: Detections3D, *, nearer: Detections3D) -> Detections3D:
    return Detections3D(
        **{
            field.name: np.concatenate([getattr(hidden, field.name), getattr(nearer, field.name)])
            for field in dataclasses.fields(Detections3D)
            if field.name != "class_names"
        },
        class_names=CLASSES,
    )


@pytest.mark.parametrize("score, believed", [(0.9, True), (0.3, False)])
def test_what_a_nearer_box_hides_does_not_count(refine: RefineDepths, score: float, believed: bool) -> None:
    left, right = behind_something(288)  # two thirds of the box
    nearer = dataclasses.replace(
        one("Car", 12.5 + REAR_TO_CENTER_M, box=(284, 50, 480, 200)), score=np.array([score], np.float64)
    )
    moved = refine(both(one("Car", 16.6), nearer=nearer), left, right, rig()).detections.center_in_camera[:, 2]
    right_m, hider_m = 15.0 + REAR_TO_CENTER_M, 12.5 + REAR_TO_CENTER_M
    assert moved[1] == pytest.approx(hider_m, rel=DEPTH_SHARE)
    assert moved[0] == pytest.approx(right_m if believed else hider_m, rel=2 * DEPTH_SHARE)


def test_what_hides_a_fifth_of_a_car_unfound_pulls_it_nowhere(refine: RefineDepths) -> None:
    left, right = behind_something(326)
    moved = refine(one("Car", 16.0), left, right, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(15.0 + REAR_TO_CENTER_M, rel=DEPTH_SHARE)


def test_two_looks_at_one_object_do_not_hide_each_other(refine: RefineDepths) -> None:
    left, right = pair(rear(15.0))
    again = one("Car", 15.5, box=(262, 62, 342, 182))
    moved = refine(both(one("Car", 17.5), nearer=again), left, right, rig()).detections.center_in_camera[:, 2]
    np.testing.assert_allclose(moved, 15.0 + REAR_TO_CENTER_M, rtol=DEPTH_SHARE)


def test_without_texture_the_depth_of_the_network_stays(refine: RefineDepths) -> None:
    flat = np.full((SIZE_WH[1], SIZE_WH[0], 3), 90, np.uint8)
    moved = refine(one("Pedestrian", 14.0), flat, flat, rig()).detections
    assert moved.center_in_camera[0, 2] == pytest.approx(14.0, rel=1e-6)


def test_only_the_distance_along_the_ray_changes(refine: RefineDepths) -> None:
    left, right = pair(wall(15.0))
    found = one("Pedestrian", 14.0)
    moved = refine(found, left, right, rig()).detections
    for name in ("class_id", "score", "box_in_left_image", "size_hwl", "alpha_rad", "yaw_rad"):
        np.testing.assert_array_equal(getattr(moved, name), getattr(found, name))
    seen = [
        FOCAL_PX * (item.center_in_camera[0, 0] + 30.0 / FOCAL_PX) / item.center_in_camera[0, 2]
        for item in (found, moved)
    ]
    assert seen[0] == pytest.approx(seen[1], abs=1e-9)


def test_same_input_same_output(refine: RefineDepths) -> None:
    left, right = pair(wall(15.0))
    first, again = (refine(one("Car", 16.0), left, right, rig()).detections.center_in_camera for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_the_library_is_left_out_where_it_is_not_wanted(monkeypatch: pytest.MonkeyPatch) -> None:
    assert refiner(use_native=False) is refine_depths
    monkeypatch.setenv("EDGE_NATIVE", "0")
    assert refiner() is refine_depths


def test_a_library_of_another_build_is_not_believed(monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = pair(wall(15.0))
    found = one("Pedestrian", 14.0)
    expected = refine_depths(found, left, right, rig())
    monkeypatch.setattr("runtime.refinement.kernel.record_call", lambda symbol: lambda *records: False)
    refined = refiner()(found, left, right, rig())
    np.testing.assert_array_equal(refined.detections.center_in_camera, expected.detections.center_in_camera)
    np.testing.assert_array_equal(refined.evidence, expected.evidence)


def test_the_library_equals_numpy_on_drawn_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Boxes of all kinds over each other, some outside the image, behind the camera's reach, or of no size."""
    native = refiner()
    if native is refine_depths:
        pytest.skip("the native library is not built")
    rng = np.random.default_rng(5)
    left, right = pair(18.0 + 6.0 * np.cos(np.arange(SIZE_WH[0]) / 90.0))
    count = 300
    corner = rng.uniform((-60, -40), (SIZE_WH[0], SIZE_WH[1] - 10), (count, 2))
    drawn = Detections3D(
        class_id=rng.integers(0, len(CLASSES), count),
        score=rng.uniform(0.1, 1.0, count),
        box_in_left_image=np.hstack([corner, corner + rng.uniform(0, (160, 140), (count, 2))]),
        center_in_camera=rng.uniform((-8, -1, 4), (8, 2, 250), (count, 3)),
        size_hwl=rng.uniform(0.4, 4.0, (count, 3)),
        alpha_rad=np.zeros(count),
        yaw_rad=rng.uniform(-np.pi, np.pi, count),
        class_names=CLASSES,
    )
    for offset_px in (0.0, 0.7):
        oracle, native_result = (item(drawn, left, right, rig(offset_px)) for item in (refine_depths, native))
        expected, found = oracle.detections.center_in_camera, native_result.detections.center_in_camera
        moved = np.any(expected != drawn.center_in_camera, axis=1)
        assert 0.2 * count < np.count_nonzero(moved) < count
        np.testing.assert_array_equal(np.any(found != drawn.center_in_camera, axis=1), moved)
        same = np.abs(found - expected).max(axis=1) < SAME_SHARE * expected[:, 2]
        assert np.mean(same) > 0.97  # between two minima as deep as each other rounding may choose
        np.testing.assert_allclose(native_result.evidence[same], oracle.evidence[same], rtol=0, atol=SAME_COST)
        assert np.any(oracle.evidence[:, -1] > 0)
