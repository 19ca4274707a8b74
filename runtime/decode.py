"""From head outputs to 3D boxes, on the CPU (paper, section III-A1; official order of steps).

Usable anchors whose best class passes the threshold are decoded, clipped, dropped where their class has no prior,
and thinned by NMS; where the manifest asks for it, what is kept becomes the mean of all that agree (`runtime.voting`).
Kept from the official code: NMS over all classes (a field of the manifest), the one-sided clip, no limit on the
number of boxes. Corrected: class names belong to their boxes; boxes at or behind the camera or
without a positive size are dropped; angles are wrapped unless ``official_angles`` asks for the recorded form.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.anchors import BoolArray, anchor_grid, usable_by_class
from runtime.boxcode import (
    ALPHA,
    CX,
    CY,
    HEIGHT,
    LENGTH,
    WIDTH,
    X1,
    X2,
    Y1,
    Y2,
    FloatArray32,
    Z,
    decode_boxes,
    rounded_arctan2,
    rounded_exp,
)
from runtime.candidates import thinning
from runtime.contracts.geometry import FloatArray
from runtime.contracts.manifest import AnchorPriors, Manifest
from runtime.contracts.objects import Detections3D, wrap_angle_rad
from runtime.hill_climbing import CLIMBING_CLASS, climb
from runtime.preprocess import NetworkView
from runtime.voting import LEAST_SCORE_SHARE

PEOPLE: Final = frozenset({"Pedestrian", "Cyclist", "Person_sitting"})
"""Classes that one person may be taken for: these suppress each other whatever their depths."""
_ANY_PERSON = -1


@dataclass(frozen=True, slots=True)
class NetworkBoxes:
    """Boxes in network pixels, by falling score.

    Attributes:
        boxes: (N, 11) float32, columns of `runtime.boxcode`.
        score: (N,) float32.
        class_id: (N,) int64.
        anchor_index: (N,) int64, the anchor that each box comes from.
    """

    boxes: FloatArray32
    score: FloatArray32
    class_id: NDArray[np.int64]
    anchor_index: NDArray[np.int64]


class Decoder:
    """Decodes one model's outputs; keeps the anchors and, for each camera, which of them are usable."""

    def __init__(self, manifest: Manifest, priors: AnchorPriors, *, use_native: bool = True) -> None:
        self._thinning = thinning(use_native=use_native)
        self._manifest = manifest
        self._priors = priors
        self._grid = anchor_grid(manifest.anchors, manifest.input_size_hw)
        self._mean, self._std = priors.by_anchor()
        self._usable: dict[bytes, tuple[BoolArray, BoolArray]] = {}
        kinds = [_ANY_PERSON if name in PEOPLE else index for index, name in enumerate(manifest.classes)]
        self._kind = np.array(kinds, np.int64)

    def usable(self, P2: FloatArray) -> BoolArray:
        """(N,) bool: anchors near the ground plane, for any class, for this projection of the network image."""
        return self._usable_by_any_and_each(P2)[0]

    def _usable_by_any_and_each(self, P2: FloatArray) -> tuple[BoolArray, BoolArray]:
        """(N,) for any class, and (classes, N) for each; worked out once a camera."""
        key = P2.tobytes()
        if key not in self._usable:
            if len(self._usable) >= 8:  # a stream has one camera; folders of many drives have a handful
                self._usable.clear()
            by_class = usable_by_class(self._grid, self._manifest.anchors, priors=self._priors, P2=P2)
            self._usable[key] = (np.asarray(by_class.any(axis=0)), by_class)
        return self._usable[key]

    def candidates(
        self, cls_logits: FloatArray32, box_deltas: FloatArray32, *, P2: FloatArray, score: float
    ) -> NetworkBoxes:
        """Decoded boxes above ``score`` whose class has a prior, before NMS, in anchor order.

        With ``filter_by_class`` also those whose class does not pass the ground-plane test are dropped.

        Args:
            cls_logits: (1, N, classes + 1), the last is the facing logit.
            box_deltas: (1, N, 12).
            P2: (3, 4) of the network image.
            score: threshold, exclusive.
        """
        logits = cls_logits[0, :, :-1]
        best = logits.max(axis=1)
        usable, usable_by_class_id = self._usable_by_any_and_each(P2)
        passed = np.flatnonzero((best > np.log(score) - np.log1p(-score)) & usable)
        label = logits[passed].argmax(axis=1)
        shape = self._grid.shape_index[passed]
        has_prior = self._mean[label, shape, 0] > 0
        if self._manifest.anchors.filter_by_class:
            has_prior &= usable_by_class_id[label, passed]
        passed, label, shape = passed[has_prior], label[has_prior], shape[has_prior]
        boxes = decode_boxes(
            box_deltas[0, passed],
            anchor_center_xy=self._grid.center_xy[passed],
            anchor_size_wh=self._grid.size_wh[passed],
            prior_mean=self._mean[label, shape],
            prior_std=self._std[label, shape],
            facing_away=cls_logits[0, passed, -1] < 0,
            depth_by_prior=self._manifest.anchors.depth_by_prior,
        )
        height, width = self._manifest.input_size_hw
        boxes[:, X1 : Y1 + 1] = np.maximum(boxes[:, X1 : Y1 + 1], 0)
        boxes[:, X2] = np.minimum(boxes[:, X2], width)
        boxes[:, Y2] = np.minimum(boxes[:, Y2], height)
        probability = 1 / (1 + rounded_exp(-best[passed]))
        return NetworkBoxes(boxes, probability.astype(np.float32), label, passed)

    def decode_in_network(
        self, cls_logits: FloatArray32, box_deltas: FloatArray32, *, P2: FloatArray, score: float
    ) -> NetworkBoxes:
        """`candidates` after NMS, by falling score; turned to fit their 2D boxes where the manifest asks for it."""
        policy = self._manifest.nms
        votes = policy.voting_iou is not None
        found = self.candidates(cls_logits, box_deltas, P2=P2, score=LEAST_SCORE_SHARE * score if votes else score)
        passed = np.flatnonzero(found.score > score) if votes else np.arange(len(found.score))
        by_depth = policy.depth_share is not None and not policy.per_class
        groups = found.class_id[passed] if policy.per_class else None
        if by_depth:
            groups = self._kind[found.class_id[passed]]
        keep = passed[
            self._thinning.suppress(
                found.boxes[passed, X1 : Y2 + 1].astype(np.float64),
                found.score[passed].astype(np.float64),
                policy.iou,
                groups=groups,
                depths=found.boxes[passed, Z].astype(np.float64) if by_depth else None,
                depth_share=policy.depth_share or 0.0,
            )
        ]
        boxes, class_id = found.boxes[keep], found.class_id[keep]
        if policy.voting_iou is not None:
            boxes = self._thinning.vote(found.boxes, found.score, found.class_id, keep, iou=policy.voting_iou)
        if self._manifest.hill_climbing and CLIMBING_CLASS in self._manifest.classes:
            cars = class_id == self._manifest.classes.index(CLIMBING_CLASS)
            boxes = climb(boxes, cars, P2=P2, size_hw=self._manifest.input_size_hw)
        return NetworkBoxes(boxes, found.score[keep], class_id, found.anchor_index[keep])

    def decode(
        self,
        cls_logits: FloatArray32,
        box_deltas: FloatArray32,
        view: NetworkView,
        *,
        score: float | None = None,
        official_angles: bool = False,
    ) -> Detections3D:
        """Boxes in the camera's pixels and frame.

        Args:
            cls_logits: (1, N, classes + 1); box_deltas: (1, N, 12).
            view: how the camera's image became the network's.
            score: threshold; None takes the manifest's ``evaluate``.
            official_angles: leave alpha and yaw unwrapped, as the official result files have them.
        """
        threshold = self._manifest.thresholds.evaluate if score is None else score
        found = self.decode_in_network(cls_logits, box_deltas, P2=view.geometry.P2, score=threshold)
        return to_detections(found, view, self._manifest.classes, official_angles=official_angles)


def to_detections(
    found: NetworkBoxes, view: NetworkView, classes: tuple[str, ...], *, official_angles: bool = False
) -> Detections3D:
    """Boxes of the network image to the camera's pixels and frame.

    In float32 and in the official code's order, so that result files agree with its own to the last printed digit:
    X = (cx z - c_x z - t_x) / f_x, Y likewise, yaw = alpha + atan2(X + t_x / f_x, z). P2's third row is left out, as
    there: z is taken as the depth in the reference frame (t_z is 2.7 mm in KITTI).
    """
    boxes = found.boxes
    real = (boxes[:, Z] > 0) & (boxes[:, WIDTH : LENGTH + 1] > 0).all(axis=1) & np.isfinite(boxes).all(axis=1)
    P2 = view.geometry.P2.astype(np.float32)
    z = boxes[:, Z]
    with np.errstate(all="ignore"):  # what overflows is dropped
        x = (boxes[:, CX] * z - P2[0, 2] * z - P2[0, 3]) / P2[0, 0]
        y = (boxes[:, CY] * z - P2[1, 2] * z - P2[1, 3]) / P2[1, 1]
        turned = boxes[:, ALPHA] + rounded_arctan2(x + P2[0, 3] / P2[0, 0], z)
    real &= np.isfinite(x) & np.isfinite(y)
    alpha = boxes[real, ALPHA].astype(np.float64)
    yaw = turned[real].astype(np.float64)
    return Detections3D(
        class_id=found.class_id[real],
        score=found.score[real].astype(np.float64),
        box_in_left_image=_to_camera_pixels(boxes[real, X1 : Y2 + 1], view).astype(np.float64),
        center_in_camera=np.stack([x, y, z], axis=1)[real].astype(np.float64),
        size_hwl=boxes[real][:, [HEIGHT, WIDTH, LENGTH]].astype(np.float64),
        alpha_rad=alpha if official_angles else wrap_angle_rad(alpha),
        yaw_rad=yaw if official_angles else wrap_angle_rad(yaw),
        class_names=classes,
    )


def _to_camera_pixels(boxes: FloatArray32, view: NetworkView) -> FloatArray32:
    """The inverse of `NetworkView.to_network` as the official code computes it: in float32, from the two cameras."""
    network, camera = view.geometry.P2.astype(np.float32), view.camera_geometry.P2.astype(np.float32)
    moved = boxes.copy()
    for axis in (0, 1):
        scale = (np.float32(1) / network[axis, axis]) * camera[axis, axis]
        shift = (np.float32(1) / scale) * camera[axis, 2] - network[axis, 2]
        moved[:, axis::2] = (boxes[:, axis::2] + shift) * scale
    return moved
