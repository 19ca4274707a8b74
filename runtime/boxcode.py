"""The 12 numbers of a box, both ways: what the network regresses and what it means (paper, section III-A1).

With anchor centre (px, py), size (pw, ph) and prior (mean m, deviation s) of the anchor's shape and class:

    x = px + 0.1 t0 pw        y = py + 0.1 t1 ph        width = pw exp(0.2 t2)    height = ph exp(0.2 t3)
    cx = px + 0.1 t4 pw       cy = py + 0.1 t5 ph       z = m_z + s_z t6
    sin 2a = m + s t7         cos 2a = m + s t8         w, h, l = m + s t9..t11

Without the depth prior (ablation of the paper, section V-A1): z = 1 / sigmoid(t6) - 1 = exp(-t6) metres.

(cx, cy) is the projected 3D centre. 2a leaves the heading's side open; a facing logit decides it (cos a > 0).
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

FloatArray32 = NDArray[np.float32]

DELTA_COUNT = 12
CENTER_FACTOR: Final = 0.1
SIZE_FACTOR: Final = 0.2
MAX_LOG_GROWTH: Final = 9.0
"""A box 8,000 times its anchor says nothing; without the bound, untrained weights overflow float32."""
# columns of a decoded box
X1, Y1, X2, Y2, CX, CY, Z, WIDTH, HEIGHT, LENGTH, ALPHA = range(11)


def rounded_exp(x: FloatArray32) -> FloatArray32:
    """Exponential of float32, rounded once: the same bits on every processor, and the official code's."""
    result: FloatArray32 = np.exp(x.astype(np.float64)).astype(np.float32)
    return result


def rounded_arctan2(y: FloatArray32, x: FloatArray32) -> FloatArray32:
    """As `rounded_exp`, the angle of (x, y)."""
    result: FloatArray32 = np.arctan2(y.astype(np.float64), x.astype(np.float64)).astype(np.float32)
    return result


def decode_boxes(
    deltas: FloatArray32,
    *,
    anchor_center_xy: FloatArray32,
    anchor_size_wh: FloatArray32,
    prior_mean: FloatArray32,
    prior_std: FloatArray32,
    facing_away: NDArray[np.bool_],
    depth_by_prior: bool = True,
) -> FloatArray32:
    """Turn regressions into boxes in network pixels, metres and radians.

    Args:
        deltas: (N, 12).
        anchor_center_xy, anchor_size_wh: (N, 2) network pixels.
        prior_mean, prior_std: (N, 6) of each anchor's shape and class: z, sin 2a, cos 2a, w, h, l.
        facing_away: (N,) where the facing probability is below one half: pi is added to alpha.
        depth_by_prior: False: depth without mean and deviation.

    Returns:
        (N, 11): x1 y1 x2 y2 cx cy z w h l alpha; alpha is not wrapped.
    """
    center = anchor_center_xy + np.float32(CENTER_FACTOR) * deltas[:, 0:2] * anchor_size_wh
    growth = np.minimum(np.float32(SIZE_FACTOR) * deltas[:, 2:4], np.float32(MAX_LOG_GROWTH))
    half = np.float32(0.5) * anchor_size_wh * rounded_exp(growth)
    projected = anchor_center_xy + np.float32(CENTER_FACTOR) * deltas[:, 4:6] * anchor_size_wh
    scaled = prior_mean + prior_std * deltas[:, 6:12]
    depth_m = scaled[:, 0:1]
    if not depth_by_prior:
        depth_m = rounded_exp(np.minimum(-deltas[:, 6:7], np.float32(MAX_LOG_GROWTH)))
    alpha = rounded_arctan2(scaled[:, 1], scaled[:, 2]) / np.float32(2)
    alpha += np.where(facing_away, np.float32(np.pi), np.float32(0))
    return np.concatenate(
        [center - half, center + half, projected, depth_m, scaled[:, 3:6], alpha[:, None]], axis=1
    ).astype(np.float32)


def encode_boxes(
    boxes: FloatArray32,
    *,
    anchor_center_xy: FloatArray32,
    anchor_size_wh: FloatArray32,
    prior_mean: FloatArray32,
    prior_std: FloatArray32,
    depth_by_prior: bool = True,
) -> FloatArray32:
    """The regressions that `decode_boxes` would turn into these boxes; arguments and columns as there."""
    center = np.float32(0.5) * (boxes[:, 0:2] + boxes[:, 2:4])
    size_wh = boxes[:, 2:4] - boxes[:, 0:2]
    alpha = boxes[:, ALPHA]
    quantities = np.stack(
        [
            boxes[:, Z],
            np.sin(2 * alpha),
            np.cos(2 * alpha),
            boxes[:, WIDTH],
            boxes[:, HEIGHT],
            boxes[:, LENGTH],
        ],
        axis=1,
    )
    scaled = (quantities - prior_mean) / prior_std
    if not depth_by_prior:
        scaled[:, 0] = -np.log(boxes[:, Z])
    return np.concatenate(
        [
            (center - anchor_center_xy) / anchor_size_wh / np.float32(CENTER_FACTOR),
            np.log(size_wh / anchor_size_wh) / np.float32(SIZE_FACTOR),
            (boxes[:, CX : CY + 1] - anchor_center_xy) / anchor_size_wh / np.float32(CENTER_FACTOR),
            scaled,
        ],
        axis=1,
    ).astype(np.float32)
