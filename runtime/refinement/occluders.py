"""Which samples of a box belong to something nearer that was found, too."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray
from runtime.contracts.objects import Detections3D
from runtime.nms import iou_one_to_many

OCCLUDER_SCORE: Final = 0.5
"""From here on a box is believed to hide what is behind it; what is shown and what is measured hide the same."""
NEARER_BY_M: Final = 0.5
SAME_OBJECT_IOU: Final = 0.5
"""Boxes that overlap by more in the image are taken for two looks at one object."""
INSET_SHARE: Final = 0.05
"""Of an occluder's box, left out at each side: corners that the object does not fill."""
LEAST_SEEN_SHARE: Final = 0.25
"""With fewer samples left, all are used."""


def seen_samples(
    found: Detections3D, row: int, depths_m: FloatArray, columns: FloatArray, rows: FloatArray
) -> NDArray[np.bool_]:
    """(rows, columns) true where no nearer box lies over a sample.

    Args:
        found: N boxes in the camera's pixels.
        row: the box that is sampled.
        depths_m: (N,) of the boxes' centres, as they stand.
        columns, rows: of the samples, camera pixels.
    """
    boxes = found.box_in_left_image
    overlap = iou_one_to_many(boxes[row], boxes)
    hides = (found.score >= OCCLUDER_SCORE) & (depths_m < depths_m[row] - NEARER_BY_M)
    hides &= (overlap > 0) & (overlap <= SAME_OBJECT_IOU)
    seen = np.ones((len(rows), len(columns)), np.bool_)
    for left, top, right, bottom in boxes[hides]:
        across, down = INSET_SHARE * (right - left), INSET_SHARE * (bottom - top)
        hidden_columns = (columns >= left + across) & (columns <= right - across)
        seen &= ~(((rows >= top + down) & (rows <= bottom - down))[:, None] & hidden_columns)
    return seen if seen.mean() >= LEAST_SEEN_SHARE else np.ones_like(seen)
