"""Faults of real camera pairs, put on top of the colour changes: two exposures, blur, noise, JPEG, rectification.

Unlike `edge.training.augment`, which repeats the official draws for both views alike, each view gets its own: a pair's
cameras never agree entirely. Disparity supervision is matched on the pair before this, and stays clean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

GAMMA_SPREAD = 0.25  # of the logarithm, shared by both views
GAIN_SPREAD, OWN_GAIN_SPREAD = 0.1, 0.05  # of logarithms: of each channel, shared and of one view
MAX_OFFSET = 6.0  # grey levels, of one view
BLUR_PX = (0.3, 1.1)
NOISE_LEVELS = (1.0, 7.0)
JPEG_QUALITY = (35, 90)
MAX_SHIFT_PX, MAX_ROLL_RAD = 0.7, 0.0008  # network pixels (1 px of KITTI's); half a pixel at the picture's ends
SHARES = {"light": 0.7, "blur": 0.25, "noise": 0.3, "jpeg": 0.25, "rectification": 0.4}
NOISE_TABLE = 1 << 16


@dataclass(frozen=True, slots=True)
class ViewFaults:
    """Of one view; None leaves a step out.

    Attributes:
        curve: (256, 3) uint8 BGR table.
        blur_px: standard deviation.
        noise: standard deviation in grey levels, and the seed of its pattern.
        jpeg_quality: of a round trip.
        shift_px, roll_rad: rectification error: down, and about the picture's middle.
    """

    curve: NDArray[np.uint8] | None = None
    blur_px: float | None = None
    noise: tuple[float, int] | None = None
    jpeg_quality: int | None = None
    shift_px: float = 0.0
    roll_rad: float = 0.0


def draw_faults(rng: np.random.Generator, *, views: int = 2) -> tuple[ViewFaults, ...]:
    """Faults of the views of one pair: which steps is the pair's, how much partly each view's."""
    has = {name: bool(rng.random() < share) for name, share in SHARES.items()}
    gamma = float(np.exp(rng.normal(0, GAMMA_SPREAD)))
    gains = np.exp(rng.normal(0, GAIN_SPREAD, 3))
    blur, noise = rng.uniform(*BLUR_PX), rng.uniform(*NOISE_LEVELS)
    quality = int(rng.integers(JPEG_QUALITY[0], JPEG_QUALITY[1] + 1))
    faults = []
    for view in range(views):
        own = gains * np.exp(rng.normal(0, OWN_GAIN_SPREAD) + rng.normal(0, OWN_GAIN_SPREAD / 2, 3))
        offset = rng.uniform(-MAX_OFFSET, MAX_OFFSET)
        crooked = has["rectification"] and view == 1  # the left view is what labels are for
        shift, roll = rng.uniform(-MAX_SHIFT_PX, MAX_SHIFT_PX), rng.uniform(-MAX_ROLL_RAD, MAX_ROLL_RAD)
        faults.append(
            ViewFaults(
                curve=_curve(gamma, own, offset) if has["light"] else None,
                blur_px=float(blur * rng.uniform(0.8, 1.25)) if has["blur"] else None,
                noise=(float(noise), int(rng.integers(2**31))) if has["noise"] else None,
                jpeg_quality=quality if has["jpeg"] else None,
                shift_px=float(shift) if crooked else 0.0,
                roll_rad=float(roll) if crooked else 0.0,
            )
        )
    return tuple(faults)


def exchange_rectification(faults: Sequence[ViewFaults]) -> tuple[ViewFaults, ViewFaults]:
    """Faults of a pair whose views will change their roles: those of rectification stay with the right one."""
    first, second = faults
    return (
        replace(first, shift_px=second.shift_px, roll_rad=second.roll_rad),
        replace(second, shift_px=first.shift_px, roll_rad=first.roll_rad),
    )


def with_faults(images: Sequence[NDArray[np.uint8]], faults: Sequence[ViewFaults]) -> list[NDArray[np.uint8]]:
    """The views (H, W, 3) uint8 BGR as faulty cameras deliver them."""
    return [_faulty(image, view) for image, view in zip(images, faults, strict=True)]


def _faulty(image: NDArray[np.uint8], faults: ViewFaults) -> NDArray[np.uint8]:
    out = image
    height, width = out.shape[:2]
    if faults.shift_px or faults.roll_rad:
        turn = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), float(np.degrees(faults.roll_rad)), 1.0)
        turn[1, 2] += faults.shift_px
        out = cv2.warpAffine(out, turn, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    if faults.blur_px is not None:
        out = cv2.GaussianBlur(out, (5, 5), faults.blur_px)
    if faults.curve is not None:
        out = cv2.LUT(out, faults.curve[None])
    if faults.noise is not None:
        level, seed = faults.noise
        rng = np.random.default_rng(seed)
        table = rng.normal(0, level, NOISE_TABLE).astype(np.float32)
        start = rng.integers(0, NOISE_TABLE // 2, height)  # rows of one table: a hundredth of the time of fresh draws
        count = min(width * 3, NOISE_TABLE // 2)
        pattern = np.stack([table[first : first + count] for first in start]).reshape(height, -1)
        pattern = np.resize(pattern, (height, width * 3)).reshape(height, width, 3)
        out = cv2.add(out, pattern, dtype=cv2.CV_8U)
    if faults.jpeg_quality is not None:
        done, data = cv2.imencode(".jpg", out, [cv2.IMWRITE_JPEG_QUALITY, faults.jpeg_quality])
        assert done
        out = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return out


def _curve(gamma: float, gains: NDArray[np.float64], offset: float) -> NDArray[np.uint8]:
    """(256, 3) uint8: gain, gamma and offset of each channel."""
    levels = np.arange(256)[:, None] / 255.0
    shaped = 255.0 * np.minimum(levels * gains, 1.0) ** gamma + offset
    return np.clip(np.rint(shaped), 0, 255).astype(np.uint8)
