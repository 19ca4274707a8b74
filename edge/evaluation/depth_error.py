"""How far off the depth of found objects is, by distance: what AP at a fixed overlap does not say."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.evaluation.agreement import by_band, pair_up
from runtime.contracts.objects import Detections3D, Objects3D

DEPTH_AXIS = 2


@dataclass(frozen=True, slots=True)
class DepthError:
    """Detected minus labelled depth of the objects that were found.

    Attributes:
        found: pairs of a detection and a label.
        median_abs_m: median of the absolute error in metres.
        bias_m: median of the signed error in metres; positive: seen too far away.
        median_share: median of the absolute error over the labelled depth.
        median_centre_m, mean_centre_m: 3D distance between the two centres in metres.
    """

    found: int
    median_abs_m: float
    bias_m: float
    median_share: float
    median_centre_m: float
    mean_centre_m: float


def depth_errors(
    labels: Sequence[Objects3D], detections: Sequence[Detections3D], *, score: float
) -> dict[str, dict[str, DepthError]]:
    """Depth error by class and distance band of the label.

    Args:
        labels, detections: one record a frame, in the same order.
        score: detections below are left out.

    Returns:
        class name -> band (``all``, ``0-15``, ...) -> error; classes and bands without a pair are absent.
    """
    names: list[str] = []
    depths, errors, shifts = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    for truth, found in zip(labels, detections, strict=True):
        found = found.above(score)
        pairs = pair_up(found, truth)
        depth = truth.center_in_camera[pairs.second, DEPTH_AXIS]
        depths.append(depth)
        errors.append(found.center_in_camera[pairs.first, DEPTH_AXIS] - depth)
        offset = found.center_in_camera[pairs.first] - truth.center_in_camera[pairs.second]
        shifts.append(np.linalg.norm(offset, axis=1))
        names += [found.class_names[index] for index in found.class_id[pairs.first]]
    depth_m, error_m, centre_m = np.concatenate(depths), np.concatenate(errors), np.concatenate(shifts)
    of_class = np.array(names, dtype=str)
    result: dict[str, dict[str, DepthError]] = {}
    for name in dict.fromkeys(names):
        rows = np.flatnonzero(of_class == name)
        bands = by_band(depth_m[rows], rows)
        result[name] = {band: _summary(error_m[part], depth_m[part], centre_m[part]) for band, part in bands.items()}
    return result


def _summary(error_m: np.ndarray, depth_m: np.ndarray, centre_m: np.ndarray) -> DepthError:
    return DepthError(
        found=len(error_m),
        median_abs_m=float(np.median(np.abs(error_m))),
        bias_m=float(np.median(error_m)),
        median_share=float(np.median(np.abs(error_m) / np.maximum(np.abs(depth_m), 1e-6))),
        median_centre_m=float(np.median(centre_m)),
        mean_centre_m=float(np.mean(centre_m)),
    )
