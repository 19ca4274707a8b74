"""What a frame's pixels say about its scene, as a short row of numbers that a later choice can compare.

Both views are shrunk first, so a frame costs a few milliseconds beside the reading of its files. Light, colour,
differences between the views, texture, coarse layout and the histogram of a block match are told apart as groups,
since what matters is that each kind of variety is covered, however many numbers describe it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.frame import StereoFrame

Row = NDArray[np.float32]

METHOD = "scene-1"
"""Name of these numbers; another one whenever they change, so that remembered rows are not mixed."""

_SMALL_WH = (320, 96)
_GRID_WH = (4, 2)
_DISPARITIES_PX, _BLOCK_PX = 48, 9
_DISPARITY_EDGES_PX = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0, 48.0)
"""Of the shrunken view: 2 px are a car at 60 m or more with KITTI's cameras, 32 px one at 4 m."""
_SUBPIXELS = 16.0  # OpenCV's block match counts in sixteenths
_STRONG_EDGE = 32.0
_BANDS = 3


@dataclass(frozen=True, slots=True)
class FeatureGroup:
    """Numbers of one kind.

    Attributes:
        name: for people.
        size: how many.
        floor: difference in one of them that is not worth telling apart, in its unit.
    """

    name: str
    size: int
    floor: float


GROUPS = (
    FeatureGroup("light", 5, 4.0),
    FeatureGroup("colour", 3, 2.0),
    FeatureGroup("views", 2, 1.0),
    FeatureGroup("texture", _BANDS + 1, 1.0),
    FeatureGroup("layout", _GRID_WH[0] * _GRID_WH[1], 4.0),
    FeatureGroup("disparity", len(_DISPARITY_EDGES_PX), 0.02),
)


def scene_row(frame: StereoFrame) -> Row:
    """Numbers about the pixels of a frame, in the order of `GROUPS`.

    Grey values run from 0 to 255; shares from 0 to 1. Without a right view the numbers about both are 0.

    Args:
        frame: A camera pair, or a single view, of any size.

    Returns:
        (sum of the groups' sizes,) float32.
    """
    left = cv2.resize(frame.left, _SMALL_WH, interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(left, cv2.COLOR_BGR2GRAY)
    right_grey = None
    if frame.right is not None:
        right = cv2.resize(frame.right, _SMALL_WH, interpolation=cv2.INTER_AREA)
        right_grey = cv2.cvtColor(right, cv2.COLOR_BGR2GRAY)
    parts = (
        _light(grey),
        _colour(left),
        _views(grey, right_grey),
        _texture(grey),
        _layout(grey),
        _disparity(grey, right_grey),
    )
    return np.concatenate(parts).astype(np.float32)


def _light(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Mean, contrast, darkest and brightest twentieth, upper half less lower half."""
    values = grey.astype(np.float64)
    half = grey.shape[0] // 2
    dark, bright = np.percentile(values, (5, 95))
    return np.array([values.mean(), values.std(), dark, bright, values[:half].mean() - values[half:].mean()])


def _colour(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Mean blue and red over green, and mean distance between the strongest and the weakest colour."""
    blue, green, red = (image[..., place].astype(np.float64) for place in range(3))
    spread = image.max(axis=2).astype(np.float64) - image.min(axis=2)
    return np.array([(blue - green).mean(), (red - green).mean(), spread.mean()])


def _views(left: NDArray[np.uint8], right: NDArray[np.uint8] | None) -> NDArray[np.float64]:
    """Left less right: of the means (exposure) and of the contrasts."""
    if right is None:
        return np.zeros(2)
    return np.array([left.mean() - right.mean(), left.std() - right.std()])


def _texture(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Mean gradient of the upper, middle and lower third, and per cent of strong edges."""
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.25)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.25)
    size = cv2.magnitude(across, down)
    bands = [float(band.mean()) for band in np.array_split(size, _BANDS)]
    return np.array([*bands, 100.0 * float((size > _STRONG_EDGE).mean())])


def _layout(grey: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Brightness of a coarse grid less that of the whole."""
    grid = cv2.resize(grey.astype(np.float32), _GRID_WH, interpolation=cv2.INTER_AREA).reshape(-1)
    return grid.astype(np.float64) - float(grid.mean())


def _disparity(left: NDArray[np.uint8], right: NDArray[np.uint8] | None) -> NDArray[np.float64]:
    """Share of the matched pixels in each bin of disparity, and share of the pixels that were matched."""
    bins = len(_DISPARITY_EDGES_PX) - 1
    if right is None:
        return np.zeros(bins + 1)
    matcher = cv2.StereoBM.create(numDisparities=_DISPARITIES_PX, blockSize=_BLOCK_PX)
    disparity_px = matcher.compute(left, right).astype(np.float32) / _SUBPIXELS
    seen = disparity_px[disparity_px >= 0]
    counts, _ = np.histogram(seen, _DISPARITY_EDGES_PX)
    return np.append(counts / max(seen.size, 1), seen.size / disparity_px.size)
