"""Colour augmentation of a stereo pair, the same draws for both views (paper, section III-A2; official ranges).

Works on float32 RGB in 0..255 without clipping. Each step consumes one draw for whether (always) and one for how much,
so that a recorded generator reproduces it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

FloatImage = NDArray[np.float32]

BRIGHTNESS = 32.0
CONTRAST = (0.5, 1.5)
SATURATION = (0.5, 1.5)
HUE_DEGREES = 18.0


class Draws(Protocol):
    """The two draws that the official code makes; `numpy.random.RandomState` has them."""

    def rand(self) -> float: ...

    def uniform(self, low: float, high: float) -> float: ...


@dataclass(frozen=True, slots=True)
class ColourChange:
    """One draw of all colour steps."""

    contrast_first: bool
    brightness: float
    contrast: float
    saturation: float
    hue_degrees: float


def draw_colour_change(draws: Draws) -> ColourChange:
    """Draw in the official order: which end contrast goes to, brightness, [contrast], saturation, hue, [contrast]."""
    contrast_first = draws.rand() <= 0.5

    def step(low: float, high: float) -> float:
        draws.rand()  # the step's probability is 1
        return draws.uniform(low, high)

    brightness = step(-BRIGHTNESS, BRIGHTNESS)
    contrast = step(*CONTRAST) if contrast_first else 1.0
    saturation = step(*SATURATION)
    hue = step(-HUE_DEGREES, HUE_DEGREES)
    if not contrast_first:
        contrast = step(*CONTRAST)
    return ColourChange(contrast_first, brightness, contrast, saturation, hue)


def change_colours(image: FloatImage, change: ColourChange) -> FloatImage:
    """Apply a colour change to one RGB image (H, W, 3) float32 in 0..255; not clipped."""
    out = image + np.float32(change.brightness)
    if change.contrast_first:
        out = out * np.float32(change.contrast)
    hsv = cv2.cvtColor(out, cv2.COLOR_RGB2HSV)
    hsv[..., 1] *= np.float32(change.saturation)
    hue = hsv[..., 0] + np.float32(change.hue_degrees)
    hue[hue > 360] -= 360
    hue[hue < 0] += 360
    hsv[..., 0] = hue
    out = cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB).astype(np.float32)
    return out if change.contrast_first else out * np.float32(change.contrast)
