"""Which anchors learn what (paper, section III-A1; official rules, the flaw of objects without overlap by option)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.training.ground_truth import GroundTruth
from runtime.anchors import AnchorGrid, BoolArray
from runtime.boxcode import ALPHA, FloatArray32, encode_boxes
from runtime.contracts.manifest import AnchorPriors

POSITIVE_IOU = 0.5
NEGATIVE_IOU = 0.4
REGION_SHARE = 0.5
IGNORED, BACKGROUND = -1, 0


@dataclass(frozen=True, slots=True)
class AnchorTargets:
    """What one image teaches.

    Attributes:
        label: (N,) int8 over all anchors: -1 ignored, 0 background, 1.. class index + 1.
        positive: (P,) int64 anchor indices, ascending; those whose class has a prior.
        ground_truth: (P,) int64, the object of each.
        deltas: (P, 12) float32.
        facing: (P,) float32, 1 where cos(alpha) > 0.
        object_count: objects of the image, for the weighting of images.
    """

    label: NDArray[np.int8]
    positive: NDArray[np.int64]
    ground_truth: NDArray[np.int64]
    deltas: FloatArray32
    facing: FloatArray32
    object_count: int


def pairwise_iou(boxes: FloatArray32, others: FloatArray32) -> FloatArray32:
    """(N, M) intersection over union of xyxy boxes."""
    overlap, areas = _overlap(boxes, others)
    other_areas = (others[:, 2] - others[:, 0]) * (others[:, 3] - others[:, 1])
    return overlap / np.maximum(areas[:, None] + other_areas[None] - overlap, np.float32(1e-8))


def _overlap(boxes: FloatArray32, others: FloatArray32) -> tuple[FloatArray32, FloatArray32]:
    lower = np.maximum(boxes[:, None, :2], others[None, :, :2])
    upper = np.minimum(boxes[:, None, 2:4], others[None, :, 2:4])
    extent = np.maximum(upper - lower, 0)
    return extent[..., 0] * extent[..., 1], (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])


def match_anchors(
    boxes: FloatArray32, truth: FloatArray32, *, claim_without_overlap: bool, low_quality_matches: bool = True
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Match anchors to objects.

    Args:
        boxes: (N, 4) anchors.
        truth: (G, 4) objects.
        claim_without_overlap: an object with no overlap claims all anchors without overlap (official flaw).
        low_quality_matches: each object claims the anchors of its largest overlap, below the threshold, too.

    Returns:
        (N,) object index, -1 ignored, -2 background, and (N,) bool background.
    """
    if len(truth) == 0:
        return np.full(len(boxes), -2, np.int64), np.ones(len(boxes), bool)
    iou = pairwise_iou(boxes, truth)
    best = iou.max(axis=1)
    match = np.where(best >= POSITIVE_IOU, iou.argmax(axis=1), np.where(best < NEGATIVE_IOU, -2, -1))
    if not low_quality_matches:
        return match, match == -2
    best_of_object = iou.max(axis=0)
    for index in range(len(truth)):
        if best_of_object[index] > 0 or claim_without_overlap:
            match[iou[:, index] == best_of_object[index]] = index
    return match, match == -2


def assign(
    truth: GroundTruth,
    grid: AnchorGrid,
    usable: BoolArray,
    *,
    priors: AnchorPriors,
    claim_without_overlap: bool = False,
    low_quality_matches: bool = True,
    usable_for_class: BoolArray | None = None,
    depth_by_prior: bool = True,
) -> AnchorTargets:
    """Assign objects to the usable anchors of one image and encode them.

    Positives whose class has no prior for the anchor's shape are ignored; with ``usable_for_class`` (classes, N) also
    those off the ground of the class that they are assigned to (paper, anchor filtering).
    """
    index = np.flatnonzero(usable)
    match, background = match_anchors(
        grid.boxes[index],
        truth.boxes[:, :4],
        claim_without_overlap=claim_without_overlap,
        low_quality_matches=low_quality_matches,
    )
    background = background & ~_on_ignored(grid.boxes[index], truth)
    label = np.full(len(usable), IGNORED, np.int8)
    label[index[background]] = BACKGROUND
    hit = match >= 0
    positive, objects = index[hit], match[hit]
    mean, std = priors.by_anchor()
    shape, classes = grid.shape_index[positive], truth.class_index[objects]
    known = mean[classes, shape, 0] > 0
    if usable_for_class is not None:
        known &= usable_for_class[classes, positive]
    positive, objects, shape, classes = positive[known], objects[known], shape[known], classes[known]
    label[positive] = classes + 1
    boxes = truth.boxes[objects]
    return AnchorTargets(
        label=label,
        positive=positive,
        ground_truth=objects,
        deltas=encode_boxes(
            boxes,
            anchor_center_xy=grid.center_xy[positive],
            anchor_size_wh=grid.size_wh[positive],
            prior_mean=mean[classes, shape],
            prior_std=std[classes, shape],
            depth_by_prior=depth_by_prior,
        ),
        facing=(np.cos(boxes[:, ALPHA]) > 0).astype(np.float32),
        object_count=len(truth.boxes),
    )


def _on_ignored(boxes: FloatArray32, truth: GroundTruth) -> BoolArray:
    ignored = np.zeros(len(boxes), bool)
    if len(truth.ignore_boxes):
        ignored |= pairwise_iou(boxes, truth.ignore_boxes).max(axis=1) >= NEGATIVE_IOU
    if len(truth.ignore_regions):
        overlap, areas = _overlap(boxes, truth.ignore_regions)
        ignored |= overlap.max(axis=1) >= REGION_SHARE * areas
    return ignored
