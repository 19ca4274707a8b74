"""From linear radiance to the 8-bit picture of a real camera: metering, lens, noise, tone curve.

The spread of the drawn values was set by eye and by simple statistics of street pictures: mean level near 95,
a tenth of the pixels darker than 18, several per cent of a picture blown out, views of a pair that differ by
a few levels.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache
from statistics import NormalDist

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.simulation.rectification import RectificationError
from runtime.contracts.errors import FrameError

_CURVE_STEPS = 4096  # entries of the tone curve's table, over the square root of [0, 1]: dark levels get enough
_NOISE_STEPS = 4096  # levels of the noise, equally likely
_FULL_WELL = 1.0
_METER_STRIDE = 6
_METER_ROUNDS = 6
_GAIN_LIMITS = (0.15, 12.0)
_LUMINANCE_RGB = np.array([0.299, 0.587, 0.114], np.float32)


@dataclass(frozen=True, slots=True)
class SensorModel:
    """One camera, as it stands during one drive.

    Attributes:
        gain_rgb: channel gains (white balance, and this camera's difference to its twin).
        mean_level: what the metering aims at, mean of the 8-bit picture.
        gamma: exponent 1 / gamma of the tone curve.
        knee: signal above which highlights are compressed; 1 is full well.
        black_level: offset added in 8-bit levels.
        saturation: 1 keeps colours, 0 is grey.
        vignetting: loss of light in the far corner, 0 none.
        veil: share of the picture's mean light that the lens scatters over all of it.
        blur_px: standard deviation of the lens blur.
        sharpening: strength of the camera's edge enhancement.
        shot_noise: variance of the signal per unit of signal.
        read_noise: standard deviation of the signal in the dark.
    """

    gain_rgb: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mean_level: float = 95.0
    gamma: float = 1.4
    knee: float = 0.85
    black_level: float = 3.0
    saturation: float = 0.9
    vignetting: float = 0.15
    veil: float = 0.0
    blur_px: float = 0.45
    sharpening: float = 0.0
    shot_noise: float = 1.5e-4
    read_noise: float = 1.5e-3


@dataclass(frozen=True, slots=True)
class StereoSensor:
    """The two cameras of a rig, and what their rectification leaves over."""

    left: SensorModel
    right: SensorModel
    error: RectificationError = field(default_factory=RectificationError)


def draw_sensor(rng: np.random.Generator) -> StereoSensor:
    """Draw the cameras of one drive: character shared, small differences between left and right."""
    warmth, tint = rng.normal(0.0, 0.06), rng.normal(0.0, 0.03)
    noisy = rng.uniform(0.3, 1.6)
    shared = SensorModel(
        gain_rgb=(float(np.exp(warmth)), float(np.exp(tint)), float(np.exp(-warmth))),
        mean_level=float(np.clip(rng.normal(96.0, 15.0), 62.0, 135.0)),
        gamma=float(rng.uniform(1.05, 1.7)),
        knee=float(rng.uniform(0.65, 0.95)),
        black_level=float(rng.uniform(0.0, 9.0)),
        saturation=float(rng.uniform(0.6, 1.15)),
        vignetting=float(rng.uniform(0.05, 0.35)),
        veil=float(max(rng.uniform(-0.04, 0.06), 0.0)),
        blur_px=float(rng.uniform(0.3, 0.6) if rng.random() < 0.8 else rng.uniform(0.6, 1.0)),
        sharpening=float(max(rng.uniform(-0.2, 0.6), 0.0)),
        shot_noise=float(3.0e-4 * noisy),
        read_noise=float(2.5e-3 * noisy),
    )
    return StereoSensor(_individual(shared, rng), _individual(shared, rng), RectificationError.draw(rng))


def meter(radiance: NDArray[np.float32], sensor: SensorModel) -> float:
    """The exposure gain that brings the picture's mean to ``sensor.mean_level``.

    One value, metered on the left view, serves both views of a pair.

    Args:
        radiance: (H, W, 3) float32 linear RGB.
    """
    _check(radiance)
    sampled = slice(_METER_STRIDE // 2, None, _METER_STRIDE)
    if min(radiance.shape[:2]) <= _METER_STRIDE:
        sampled = slice(None)
    luminance = radiance[sampled, sampled] @ _LUMINANCE_RGB
    curve = _tone_curve(sensor.gamma, sensor.knee, sensor.black_level).astype(np.float64)
    low, high = np.log(_GAIN_LIMITS[0]), np.log(_GAIN_LIMITS[1])
    for _ in range(2 * _METER_ROUNDS):
        middle = (low + high) / 2
        level = curve[_curve_index(luminance * np.float32(np.exp(middle)))].mean()
        low, high = (middle, high) if level < sensor.mean_level else (low, middle)
    return float(np.exp((low + high) / 2))


def expose(
    radiance: NDArray[np.float32], sensor: SensorModel, rng: np.random.Generator, *, gain: float | None = None
) -> NDArray[np.uint8]:
    """Take the picture.

    Args:
        radiance: (H, W, 3) float32 linear RGB, not changed.
        sensor: the camera.
        rng: source of the noise.
        gain: exposure gain; None meters this picture alone (for a pair, meter once and pass it to both).

    Returns:
        (H, W, 3) uint8 BGR.

    Raises:
        FrameError: radiance is not (H, W, 3) float32.
    """
    _check(radiance)
    if gain is None:
        gain = meter(radiance, sensor)
    height, width = radiance.shape[:2]
    signal = cv2.cvtColor(radiance, cv2.COLOR_RGB2BGR)
    # full well clips after the lens has spread the light, so blown areas bleed over thin dark things
    signal = cv2.GaussianBlur(signal, (5, 5), sensor.blur_px)
    if sensor.veil > 0.0:
        signal = cv2.add(signal, tuple(sensor.veil * level for level in cv2.mean(signal)))
    gains_bgr = np.array(sensor.gain_rgb[::-1], np.float32) * np.float32(gain)
    signal = cv2.multiply(signal, _vignette((height, width), sensor.vignetting))
    signal = cv2.transform(signal, np.diag(gains_bgr))
    np.minimum(signal, np.float32(_FULL_WELL), out=signal)
    spread = cv2.sqrt(signal * np.float32(sensor.shot_noise) + np.float32(sensor.read_noise**2))
    noise = _normal_quantiles().take(rng.integers(0, _NOISE_STEPS, signal.shape, dtype=np.uint16))
    signal += cv2.multiply(noise, spread)
    if sensor.saturation != 1.0:
        signal = cv2.transform(signal, _saturation_matrix(sensor.saturation))
    picture = _tone_curve(sensor.gamma, sensor.knee, sensor.black_level).take(_curve_index(signal))
    if sensor.sharpening > 0.0:
        soft = cv2.GaussianBlur(picture, (3, 3), 0.8)
        picture = cv2.addWeighted(picture, 1.0 + sensor.sharpening, soft, -sensor.sharpening, 0.0)
    return picture


def _individual(shared: SensorModel, rng: np.random.Generator) -> SensorModel:
    level = rng.normal(0.0, 0.018)
    gains = [gain * np.exp(level + rng.normal(0.0, 0.008)) for gain in shared.gain_rgb]
    return replace(
        shared,
        gain_rgb=(float(gains[0]), float(gains[1]), float(gains[2])),
        black_level=float(max(shared.black_level + rng.normal(0.0, 0.5), 0.0)),
        blur_px=float(shared.blur_px * np.exp(rng.normal(0.0, 0.08))),
        vignetting=float(shared.vignetting * rng.uniform(0.8, 1.2)),
    )


def _check(radiance: NDArray[np.float32]) -> None:
    if radiance.ndim != 3 or radiance.shape[2] != 3 or radiance.dtype != np.float32:
        raise FrameError(
            f"found radiance {radiance.shape} {radiance.dtype}, expected (H, W, 3) float32 linear RGB; "
            "pass RenderedView.radiance"
        )


def _curve_index(signal: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Table index of each signal value, clipped to the table."""
    rooted = np.sqrt(np.clip(signal, np.float32(0.0), np.float32(1.0)))
    return (rooted * np.float32(_CURVE_STEPS - 1) + np.float32(0.5)).astype(np.uint16)


@lru_cache(maxsize=64)
def _tone_curve(gamma: float, knee: float, black_level: float) -> NDArray[np.uint8]:
    """(steps,) uint8: straight to the knee, a shoulder that meets full scale at full well, then gamma."""
    signal = np.linspace(0.0, 1.0, _CURVE_STEPS) ** 2
    reach = 1.0 - knee
    # s + s**2 / 2 - s**3 / 2 meets both ends, with slope 1 at the knee and a gentle half at full well
    over = np.clip((signal - knee) / reach, 0.0, 1.0)
    shaped = np.where(signal > knee, knee + reach * (over + 0.5 * over**2 * (1.0 - over)), signal)
    levels = black_level + (255.0 - black_level) * shaped ** (1.0 / gamma)
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)


@lru_cache(maxsize=1)
def _normal_quantiles() -> NDArray[np.float32]:
    """(steps,) float32 standard normal values, equally likely, of unit variance."""
    normal = NormalDist()
    values = np.array([normal.inv_cdf((step + 0.5) / _NOISE_STEPS) for step in range(_NOISE_STEPS)])
    return (values / values.std()).astype(np.float32)


@lru_cache(maxsize=16)
def _vignette(size_hw: tuple[int, int], strength: float) -> NDArray[np.float32]:
    """(H, W, 3) float32 share of light, 1 in the middle, 1 - strength in the corners."""
    height, width = size_hw
    rows = (np.arange(height) + 0.5 - height / 2)[:, None]
    columns = (np.arange(width) + 0.5 - width / 2)[None, :]
    radius_squared = (rows**2 + columns**2) / (height**2 + width**2) * 4.0
    share = 1.0 - strength * radius_squared
    return np.repeat(share.astype(np.float32)[:, :, None], 3, axis=2)


def _saturation_matrix(saturation: float) -> NDArray[np.float32]:
    """(3, 3) BGR matrix that moves colours from (0) or past (> 1) their grey."""
    grey = np.tile(_LUMINANCE_RGB[::-1], (3, 1))
    return (grey + saturation * (np.eye(3, dtype=np.float32) - grey)).astype(np.float32)
