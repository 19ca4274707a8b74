"""The sensor model: what it keeps, what it adds, and that it is the same again."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edge.simulation.sensor import SensorModel, draw_sensor, expose, meter
from runtime.contracts.errors import FrameError

HEIGHT, WIDTH = 48, 480
LEVEL_TOLERANCE = 2.0  # 8-bit levels; metering looks at every sixth pixel and knows no vignette and no noise
PLAIN = SensorModel(black_level=0.0, saturation=1.0, vignetting=0.0, blur_px=0.35, shot_noise=0.0, read_noise=0.0)


def _flat(*rgb: float) -> np.ndarray:
    return np.broadcast_to(np.array(rgb, np.float32), (HEIGHT, WIDTH, 3)).copy()


def _ramp() -> np.ndarray:
    ramp = np.linspace(0.0, 0.9, WIDTH, dtype=np.float32)
    return np.broadcast_to(ramp[None, :, None], (HEIGHT, WIDTH, 3)).copy()


def _rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.mark.parametrize("radiance", [np.zeros((4, 4), np.float32), np.zeros((4, 4, 3), np.float64)])
def test_anything_but_float32_rgb_is_refused(radiance: np.ndarray) -> None:
    with pytest.raises(FrameError, match="float32"):
        expose(radiance, PLAIN, _rng())


def test_a_black_scene_stays_at_the_black_level() -> None:
    picture = expose(_flat(0, 0, 0), dataclasses.replace(PLAIN, black_level=4.0), _rng())
    assert picture.dtype == np.uint8 and picture.shape == (HEIGHT, WIDTH, 3)
    assert (picture == 4).all()


def test_what_is_far_too_bright_is_blown_out_without_wrapping() -> None:
    assert (expose(_flat(50, 50, 50), PLAIN, _rng(), gain=1.0) == 255).all()


def test_channels_come_out_blue_green_red() -> None:
    picture = expose(_flat(0.6, 0.3, 0.1), PLAIN, _rng(), gain=1.0)
    blue, green, red = picture[10, 10].tolist()
    assert blue < green < red


def test_the_input_is_not_changed() -> None:
    radiance = _ramp()
    before = radiance.copy()
    expose(radiance, draw_sensor(_rng()).left, _rng())
    np.testing.assert_array_equal(radiance, before)


def test_more_light_is_never_darker() -> None:
    row = expose(_ramp(), PLAIN, _rng(), gain=1.0)[HEIGHT // 2, :, 1].astype(int)
    assert (np.diff(row) >= 0).all()
    assert row[-1] - row[0] > 200


@pytest.mark.parametrize("brightness", [0.05, 0.4, 3.0])
def test_metering_brings_the_mean_to_its_aim(brightness: float) -> None:
    radiance = _ramp() * np.float32(brightness)
    picture = expose(radiance, PLAIN, _rng(), gain=meter(radiance, PLAIN))
    assert abs(picture.mean() - PLAIN.mean_level) < LEVEL_TOLERANCE


def test_noise_has_no_bias_and_grows_with_its_parameters() -> None:
    grey = _flat(0.3, 0.3, 0.3)
    clean = expose(grey, PLAIN, _rng(), gain=1.0).astype(float)
    spreads = []
    for strength in (0.5, 1.0, 2.0):
        noisy = dataclasses.replace(PLAIN, shot_noise=3e-4 * strength**2, read_noise=3e-3 * strength)
        picture = expose(grey, noisy, _rng(), gain=1.0).astype(float)
        assert abs(picture.mean() - clean.mean()) < 0.5
        spreads.append(picture.std())
    assert spreads[0] < 0.7 * spreads[1] < 0.7 * 0.7 * spreads[2]


def test_noise_differs_between_the_views_and_not_between_runs() -> None:
    sensor, grey, rng = draw_sensor(_rng()).left, _flat(0.3, 0.3, 0.3), _rng()
    first, second = expose(grey, sensor, rng, gain=1.0), expose(grey, sensor, rng, gain=1.0)
    assert (first != second).any()
    np.testing.assert_array_equal(first, expose(grey, sensor, _rng(), gain=1.0))


def test_vignetting_darkens_corners_only() -> None:
    picture = expose(_flat(0.3, 0.3, 0.3), dataclasses.replace(PLAIN, vignetting=0.4), _rng(), gain=1.0)
    plain = expose(_flat(0.3, 0.3, 0.3), PLAIN, _rng(), gain=1.0)
    assert abs(int(picture[HEIGHT // 2, WIDTH // 2, 1]) - int(plain[0, 0, 1])) <= 1
    assert picture[0, 0, 1] < 0.9 * plain[0, 0, 1]


def test_drawn_cameras_of_a_rig_are_near_twins_and_rigs_differ() -> None:
    grey = _flat(0.25, 0.25, 0.25)
    differences, gammas = [], []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        sensor = draw_sensor(rng)
        views = [expose(grey, camera, rng, gain=1.0).mean() for camera in (sensor.left, sensor.right)]
        differences.append(abs(views[0] - views[1]))
        gammas.append(sensor.left.gamma)
    assert 0.2 < np.median(differences) < 6.0
    assert max(differences) < 20.0
    assert np.std(gammas) > 0.1


def test_the_same_seed_draws_the_same_cameras() -> None:
    assert draw_sensor(_rng()) == draw_sensor(_rng())
