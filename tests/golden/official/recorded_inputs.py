"""Cameras and random head outputs of the recorded cases, made anew by the rule that the recordings state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

P2_CAMERA = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3_CAMERA = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])
BOX_TERMS = 12


def head_outputs(
    seed: int, shape: tuple[int, int, int], *, logits: tuple[float, float], facing_shift: float, box_deviation: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Class logits with the facing logit last, and box regressions, from one generator, in this order.

    Args:
        seed: of the recording.
        shape: images, anchors, classes.
        logits: mean and deviation.
        facing_shift: added to the facing logit.
        box_deviation: of the regressions.
    """
    images, anchors, classes = shape
    draw = np.random.Generator(np.random.PCG64(seed))
    mean, deviation = logits
    values = (mean + deviation * draw.standard_normal((images, anchors, classes + 1))).astype(np.float32)
    values[..., -1] += facing_shift
    boxes = (box_deviation * draw.standard_normal((images, anchors, BOX_TERMS))).astype(np.float32)
    return values, boxes
