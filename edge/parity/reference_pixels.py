"""What a network should see of a frame, worked out from the manifest in NumPy float64 alone.

A second opinion on `runtime.preprocess`: no OpenCV, no 8-bit rounding, no code shared with it. Slow; for a few
frames. Values are levels, 0 to 255, before normalisation, as 8-bit and float models can be compared in them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.manifest import Manifest, Normalisation

Levels = NDArray[np.float64]


def reference_levels(frame: StereoFrame, manifest: Manifest) -> dict[str, Levels]:
    """Both views as the network should see them.

    Args:
        frame: the camera pair.
        manifest: of the model.

    Returns:
        view name -> (3, height, width) RGB in 0..255, float64; ``left`` alone for a model of one view.
    """
    first_row, scale = first_row_and_scale(frame.geometry, manifest)
    images = {"left": frame.left}
    if manifest.views == 2 and frame.right is not None:
        images["right"] = frame.right
    return {
        name: _seen(image, first_row, scale, manifest.input_size_hw)[::-1]  # BGR to RGB
        for name, image in images.items()
    }


def first_row_and_scale(geometry: StereoGeometry, manifest: Manifest) -> tuple[int, float]:
    """The camera row at the network's top (negative: black rows come first), and network pixels a camera pixel.

    ``top_rows``: the rows below the cut fill the network's height. ``above_horizon``: the focal length becomes the
    network's, and the cut lies as many rows above the principal row as the training camera's, in its scale.
    """
    if manifest.crop.mode == "top_rows":
        return manifest.crop.rows, manifest.input_size_hw[0] / (geometry.image_size_wh[1] - manifest.crop.rows)
    focal_px, network_px = float(geometry.P2[0, 0]), manifest.rig.focal_px
    above_horizon = manifest.crop.rows * focal_px / (manifest.crop.training_focal_px or network_px)
    return round(float(geometry.P2[1, 2]) - above_horizon), network_px / focal_px


def normalised(levels: Levels, normalisation: Normalisation) -> Levels:
    """(..., 3, H, W) levels to ``(v / 255 - mean) / std``."""
    mean, std = _statistics(normalisation)
    return (levels / 255.0 - mean) / std


def levels_of(values: NDArray[np.generic], normalisation: Normalisation) -> Levels:
    """The inverse of `normalised`."""
    mean, std = _statistics(normalisation)
    return (values.astype(np.float64) * std + mean) * 255.0


def _statistics(normalisation: Normalisation) -> tuple[Levels, Levels]:
    mean, std = (np.array(item, np.float64).reshape(3, 1, 1) for item in (normalisation.mean, normalisation.std))
    return mean, std


def _seen(image: NDArray[np.uint8], first_row: int, scale: float, size_hw: tuple[int, int]) -> Levels:
    """Cut, resize, cut or pad; (3, height, width) in the image's order of channels."""
    height, width = size_hw
    top = max(first_row, 0)
    rows = max(round(height / scale) - (top - first_row), 1)
    cut = image[top : top + rows].astype(np.float64)
    resized_hw = (max(round(cut.shape[0] * scale), 1), max(round(cut.shape[1] * scale), 1))
    resized = _bilinear(_bilinear(cut, resized_hw[0], axis=0), resized_hw[1], axis=1)
    black_rows = round((top - first_row) * scale)
    resized = resized[: height - black_rows, :width]
    seen = np.zeros((height, width, 3))
    seen[black_rows : black_rows + resized.shape[0], : resized.shape[1]] = resized
    return seen.transpose(2, 0, 1)


def _bilinear(values: Levels, size: int, *, axis: int) -> Levels:
    """Linear resize of one axis; pixel centres lie at halves, the border pixel goes on outside."""
    length = values.shape[axis]
    place = np.clip((np.arange(size) + 0.5) * length / size - 0.5, 0.0, length - 1)
    before = np.minimum(np.floor(place).astype(np.int64), max(length - 2, 0))
    after = np.minimum(before + 1, length - 1)
    shape = [1, 1, 1]
    shape[axis] = size
    share = (place - before).reshape(shape)
    result: Levels = values.take(before, axis) * (1.0 - share) + values.take(after, axis) * share
    return result
