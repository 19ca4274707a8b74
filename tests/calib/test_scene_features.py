"""What rows of features tell of pixels and of objects."""

from __future__ import annotations

import numpy as np
import pytest

from calib import object_features, scene_features
from calib.object_features import object_row
from calib.scene_features import scene_row
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D

SIZE_WH = (640, 192)


def group_of(row: np.ndarray, name: str, groups=scene_features.GROUPS) -> np.ndarray:
    start = 0
    for group in groups:
        if group.name == name:
            return row[start : start + group.size]
        start += group.size
    raise AssertionError(name)


def pair(left: np.ndarray, right: np.ndarray | None) -> StereoFrame:
    size_wh = (left.shape[1], left.shape[0])
    return StereoFrame(left, right, 0.0, 0, "000000", StereoGeometry(np.eye(3, 4), np.eye(3, 4), size_wh))


def textured(seed: int = 0) -> np.ndarray:
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 256, (48, 160, 3)).astype(np.uint8)
    return cv2.resize(coarse, SIZE_WH, interpolation=cv2.INTER_CUBIC)


def found(*objects: tuple[int, float]) -> Detections3D:
    """Objects of (class, distance in metres)."""
    count = len(objects)
    centers = np.array([(0.0, 1.0, distance_m) for _, distance_m in objects]).reshape(count, 3)
    return Detections3D(
        class_id=np.array([number for number, _ in objects], np.int64),
        score=np.linspace(0.9, 0.5, count),
        box_in_left_image=np.tile([0.0, 0.0, 10.0, 10.0], (count, 1)),
        center_in_camera=centers,
        size_hwl=np.ones((count, 3)),
        alpha_rad=np.zeros(count),
        yaw_rad=np.zeros(count),
        class_names=("Car", "Pedestrian", "Van"),
    )


@pytest.mark.parametrize("size_hw", [(1, 1), (2, 4), (64, 128), (375, 1242)])
@pytest.mark.parametrize("views", [1, 2])
def test_any_size_gives_a_finite_row_of_one_length(size_hw, views) -> None:
    image = np.full((*size_hw, 3), 100, np.uint8)
    row = scene_row(pair(image, image if views == 2 else None))
    assert row.shape == (sum(group.size for group in scene_features.GROUPS),)
    assert row.dtype == np.float32
    assert np.isfinite(row).all()


def test_light_is_seen_and_nothing_else_of_a_flat_picture() -> None:
    dark, bright = (scene_row(pair(image, image)) for image in (np.full((96, 320, 3), v, np.uint8) for v in (20, 220)))
    assert bright[0] - dark[0] == pytest.approx(200)
    for name in ("colour", "views", "texture", "layout", "disparity"):
        np.testing.assert_array_equal(group_of(dark, name), group_of(bright, name))


def test_colour_exposure_and_layout_are_told_apart() -> None:
    image = textured()
    plain = scene_row(pair(image, image))
    red = image.copy()
    red[..., 2] = np.minimum(image[..., 2].astype(int) + 60, 255)
    assert group_of(scene_row(pair(red, red)), "colour")[1] > group_of(plain, "colour")[1] + 20
    dim = (image * 0.8).astype(np.uint8)
    assert group_of(plain, "views")[0] == pytest.approx(0)
    assert group_of(scene_row(pair(image, dim)), "views")[0] > 10
    night_above = image.copy()
    night_above[: SIZE_WH[1] // 2] //= 8
    assert group_of(scene_row(pair(night_above, night_above)), "layout")[:4].max() < -20


@pytest.mark.parametrize(("shift_px", "place"), [(2, 0), (6, 1), (24, 3), (48, 4)])
def test_disparity_falls_into_its_bin(shift_px, place) -> None:
    """Shifts of the full picture; the match works on half its width."""
    image = textured(3)
    row = scene_row(pair(image, np.roll(image, -shift_px, axis=1)))
    shares = group_of(row, "disparity")[:-1]
    assert int(shares.argmax()) == place
    assert shares[place] > 0.8
    assert shares.sum() == pytest.approx(1.0, abs=1e-6)


def test_objects_by_class_distance_and_nearness() -> None:
    none = object_row(found())
    assert none.shape == (sum(group.size for group in object_features.GROUPS),)
    assert not none.any()
    row = object_row(found((0, 8.0), (0, 40.0), (2, 20.0)))
    np.testing.assert_allclose(
        group_of(row, "classes", object_features.GROUPS), np.log1p([2, 0, 0, 1]), rtol=1e-6
    )  # a van is among the rest
    bands = group_of(row, "distance", object_features.GROUPS)
    np.testing.assert_allclose(bands, [*np.log1p([1, 1, 1, 0]), 2.0 / 8.0], rtol=1e-6)
