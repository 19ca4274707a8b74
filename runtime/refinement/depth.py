"""Depth from the pixels themselves: each found box is moved along its ray until both views of it match best.

The network sees the pair at a fraction of its resolution and in cells of 4 and 8 pixels; what it says of depth is good
to a third of a pixel or so, and in 8 bits a little less. The camera's images hold more. The visible surface of a box
(the facing sides of a vehicle's body and cabin, an upright plane for people) is sampled in the left image and looked up
in the right one at disparities around the network's; the one that matches best, with a mild preference for the
network's own, gives the new depth. The box keeps its place in the image, its size and its angles. The idea is that of
dense alignment (Stereo R-CNN, CVPR 2019, section 5); surface, matching cost, search and prior are this project's own.

Both views are compared after local normalisation, so that exposure may differ. What hides an object must not give it
its depth: boxes are moved from near to far, a vehicle's samples under a nearer box are left out, and of its patches
those that match worst do not count. People are looked at through a narrow strip, hidden as a whole or not at all.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D
from runtime.refinement.evidence import UNSEARCHED, Refined
from runtime.refinement.matching import WINDOW_PX, Pixels, best_depth, normalised
from runtime.refinement.occluders import seen_samples
from runtime.refinement.samples import BoxSamples
from runtime.refinement.surface import FEWEST, VEHICLES, sample_positions, surface_behind_center


def refine_depths(found: Detections3D, left: Pixels, right: Pixels, geometry: StereoGeometry) -> Refined:
    """Moves boxes along their rays to where the two views match best.

    Args:
        found: N boxes in the camera's pixels and frame.
        left, right: (H, W, 3) uint8 BGR, the rectified pair.
        geometry: of the pair; a difference of the principal columns counts as an offset of all disparities.

    Returns:
        The same boxes, in the same order, with other centres. Boxes that are too small, too far or show no side are
        returned as they were.
    """
    evidence = np.tile(UNSEARCHED, (len(found), 1))
    if len(found) == 0:
        return Refined(found, evidence)
    first, last = image_rows(found, left.shape[0])
    views = (normalised(left[first:last]), normalised(right[first:last]))
    P2, P3 = geometry.P2, geometry.P3
    focal_baseline, offset_px = float(P2[0, 3] - P3[0, 3]), float(P2[0, 2] - P3[0, 2])
    shift = geometry.to_left_camera_m
    centers = found.center_in_camera.copy()
    for row in np.argsort(centers[:, 2], kind="stable"):
        kind = found.class_names[int(found.class_id[row])]
        solid = kind in VEHICLES
        columns, rows = sample_positions(found.box_in_left_image[row], left.shape[:2], kind)
        if len(rows) == 0:
            continue
        top, bottom = found.box_in_left_image[row, 1::2]
        behind_m = surface_behind_center(
            columns,
            (rows - top) / (bottom - top),
            P2,
            centers[row] + shift,
            found.size_hwl[row],
            float(found.yaw_rad[row]),
            solid=solid,
        )
        hit = np.isfinite(behind_m[0])
        if np.count_nonzero(hit) < FEWEST - 1:
            continue
        columns, behind_m = columns[hit], behind_m[:, hit]
        seen = np.ones((len(rows), len(columns)), np.bool_)
        if solid:
            seen = seen_samples(found, int(row), centers[:, 2], columns, rows)
        samples = BoxSamples.look(
            *views,
            columns,
            rows - first,
            seen,
            behind_m,
            focal_baseline=focal_baseline,
            offset_px=offset_px,
            solid=solid,
        )
        depth_m, evidence[row, :-1] = best_depth(samples, float(centers[row, 2]))
        evidence[row, -1] = 1.0 - seen.mean()
        centers[row] = (centers[row] + shift) * (depth_m / centers[row, 2]) - shift
    return Refined(dataclasses.replace(found, center_in_camera=centers), evidence)


def image_rows(found: Detections3D, height: int) -> tuple[int, int]:
    """First and last image row that any box, and the window about it, reaches."""
    boxes = found.box_in_left_image
    first = int(np.clip(np.floor(boxes[:, 1].min()) - WINDOW_PX, 0, height - 1))
    last = int(np.clip(np.ceil(boxes[:, 3].max()) + WINDOW_PX, first + 1, height))
    return first, last
