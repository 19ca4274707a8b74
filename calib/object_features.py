"""What stands in a frame, as a short row of numbers: classes, how many, how near.

The objects are the source's labels where it has them, else what the float model finds.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from calib.scene_features import FeatureGroup, Row
from runtime.contracts.objects import Detections3D, Objects3D

NAMED_CLASSES = ("Car", "Pedestrian", "Cyclist")
"""Told apart; all others count together."""
METHOD = "objects-1"
"""Name of these numbers; another one whenever they change, so that remembered rows are not mixed."""
_BAND_EDGES_M = (0.0, 15.0, 30.0, 50.0, np.inf)
_NEAREST_M = 2.0  # nearer objects are as near as can be

GROUPS = (
    FeatureGroup("classes", len(NAMED_CLASSES) + 1, 0.3),
    FeatureGroup("distance", len(_BAND_EDGES_M), 0.3),
)


def object_row(objects: Objects3D | Detections3D) -> Row:
    """Numbers about the objects of a frame, in the order of `GROUPS`.

    Counts enter by their logarithm: one car or none matters more than eleven or ten.

    Returns:
        (sum of the groups' sizes,) float32: log(1 + count) of each named class and of the rest; of each band of
        distance; and nearness, which is 0 without objects and 1 at 2 m.
    """
    names = [objects.class_names[number] for number in objects.class_id]
    named = [names.count(name) for name in NAMED_CLASSES]
    distance_m = objects.center_in_camera[:, 2]
    bands = [int(((distance_m >= near) & (distance_m < far)).sum()) for near, far in pairwise(_BAND_EDGES_M)]
    nearness = 0.0 if len(names) == 0 else _NEAREST_M / max(float(distance_m.min()), _NEAREST_M)
    counts = np.log1p([*named, len(names) - sum(named), *bands])
    return np.append(counts, nearness).astype(np.float32)
