"""Weights and images of the recorded network cases, made anew by the rule that the recordings state.

The weights are a function of the official names and shapes alone, the images of a seed: nothing large is stored.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

CASE_STRIDE = 1000003
MARGIN_PX = 48
LOSS_CONSTANTS = {  # buffers that official checkpoints carry beside the weights
    "bbox_head.balance_weights": [20.0, 40.0],
    "bbox_head.regression_weight": [1.0] * 6 + [12.0, 1.0, 1.0, 0.5, 0.5, 0.5, 1.0],
    "bbox_head.loss_cls.balance_weights": [20.0, 40.0],
}
_GAIN = {
    "bbox_head.cls_feature_extraction.6.weight": 0.25,
    "bbox_head.reg_feature_extraction.3.weight": 0.35,
}
_OFFSET = {"bbox_head.cls_feature_extraction.6.bias": -1.7}
_MEAN, _STD = np.array([0.485, 0.456, 0.406], np.float32), np.array([0.229, 0.224, 0.225], np.float32)


def tensor(name: str, shape: tuple[int, ...], case: int = 0) -> NDArray[np.generic]:
    """One entry of a recorded case's checkpoint; ``name`` is the official one."""
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    draw = np.random.Generator(np.random.PCG64((zlib.crc32(name.encode()) + CASE_STRIDE * case) % 2**32))
    if name.endswith("running_var"):
        values = draw.uniform(0.5, 1.5, shape)
    elif name.endswith("running_mean"):
        values = 0.1 * draw.standard_normal(shape)
    elif len(shape) > 1:
        values = np.sqrt(2.0 / np.prod(shape[1:])) * draw.standard_normal(shape)
    elif name.endswith("weight"):
        last_norm = name.endswith(("bn2.weight", "bn3.weight"))
        values = draw.uniform(*((0.2, 0.4) if last_norm else (0.8, 1.2)), shape)
    else:
        values = 0.05 * draw.standard_normal(shape)
    return (values * _GAIN.get(name, 1.0) + _OFFSET.get(name, 0.0)).astype(np.float32)


def state_dict(shapes: Mapping[str, tuple[int, ...]], case: int = 0) -> dict[str, NDArray[np.generic]]:
    """A whole checkpoint, by official names and their shapes."""
    return {name: tensor(name, shape, case) for name, shape in shapes.items()}


def image_pair(height: int, width: int, seed: int) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Textured RGB pair, (H, W, 3) each; row y has a disparity of ``4 + 40 y // height`` pixels."""
    draw = np.random.Generator(np.random.PCG64(seed))
    texture = draw.integers(0, 256, (height, width + 2 * MARGIN_PX, 3)).astype(np.float64)
    for axis in (0, 1):
        texture = sum(np.roll(texture, step, axis) for step in (-2, -1, 0, 1, 2)) / 5
    texture = np.floor(np.clip((texture - 127.5) * 2.5 + 127.5, 0, 255)).astype(np.uint8)
    begins = MARGIN_PX + 4 + (np.arange(height) * 40) // height
    columns = begins[:, None] + np.arange(width)
    return texture[:, MARGIN_PX : MARGIN_PX + width].copy(), np.take_along_axis(texture, columns[..., None], axis=1)


def normalised(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """(H, W, 3) uint8 RGB to (1, 3, H, W) float32, as the official code normalises."""
    scaled = image.astype(np.float32) / np.float32(255)
    return np.ascontiguousarray(((scaled - _MEAN) / _STD).transpose(2, 0, 1)[None])
