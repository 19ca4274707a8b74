"""Labels and detections of all frames as flat tables, with all their overlaps, computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.evaluation.rotated_iou import intersection_areas
from edge.evaluation.rules import LOWEST_OVERLAP, Metric
from runtime.contracts.errors import FormatError
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import Detections3D, FloatArray, IntArray, Objects3D


@dataclass(frozen=True, slots=True)
class LabelTable:
    """Labelled objects of F frames, in frame order and file order.

    Attributes:
        frames: F; frame: (G,) index of each object's frame; class_id: (G,) into `KITTI_CLASSES`.
        box_in_left_image: (G, 4) pixels; solid: (G, 7) x, z, length, width, yaw, top y, bottom y in metres
            and radians.
        alpha_rad, truncation, occlusion: (G,).
        region_frame: (R,) and region_box: (R, 4): DontCare regions.
    """

    frames: int
    frame: IntArray
    class_id: IntArray
    box_in_left_image: FloatArray
    solid: FloatArray
    alpha_rad: FloatArray
    truncation: FloatArray
    occlusion: IntArray
    region_frame: IntArray
    region_box: FloatArray


@dataclass(frozen=True, slots=True)
class DetectionTable:
    """Detections of F frames; attributes as in `LabelTable`, and score: (D,)."""

    frames: int
    frame: IntArray
    class_id: IntArray
    box_in_left_image: FloatArray
    solid: FloatArray
    alpha_rad: FloatArray
    score: FloatArray


@dataclass(frozen=True, slots=True)
class PairTable:
    """Detections beside labels of the same frame that overlap by at least `LOWEST_OVERLAP` in some metric.

    Attributes:
        detection, label: (P,) rows of the two tables, ordered by label, then detection.
        overlap: metric to (P,) intersection over union.
        region_cover: (D,) largest share of a detection's 2D box that one DontCare region covers.
    """

    detection: IntArray
    label: IntArray
    overlap: dict[Metric, FloatArray]
    region_cover: FloatArray


def label_table(labels: Sequence[Objects3D]) -> LabelTable:
    """Stack the labels of frames 0..F-1."""
    regions = [item.dont_care_boxes for item in labels]
    return LabelTable(
        frames=len(labels),
        frame=_frame_index([len(item) for item in labels]),
        class_id=_common_class_ids(labels),
        box_in_left_image=_stack([item.box_in_left_image for item in labels], 4),
        solid=_solids(labels),
        alpha_rad=_stack([item.alpha_rad for item in labels]),
        truncation=_stack([item.truncation for item in labels]),
        occlusion=_stack([item.occlusion for item in labels]).astype(np.int64),
        region_frame=_frame_index([len(item) for item in regions]),
        region_box=_stack(regions, 4),
    )


def detection_table(detections: Sequence[Detections3D]) -> DetectionTable:
    """Stack the detections of frames 0..F-1."""
    return DetectionTable(
        frames=len(detections),
        frame=_frame_index([len(item) for item in detections]),
        class_id=_common_class_ids(detections),
        box_in_left_image=_stack([item.box_in_left_image for item in detections], 4),
        solid=_solids(detections),
        alpha_rad=_stack([item.alpha_rad for item in detections]),
        score=_stack([item.score for item in detections]),
    )


def _frame_index(counts: Sequence[int]) -> IntArray:
    return np.repeat(np.arange(len(counts), dtype=np.int64), counts)


def _stack(arrays: Sequence[FloatArray | IntArray], *tail: int) -> FloatArray:
    return np.concatenate([np.zeros((0, *tail)), *arrays])


def _common_class_ids(records: Sequence[Objects3D] | Sequence[Detections3D]) -> IntArray:
    """Class ids into `KITTI_CLASSES`; a class that KITTI does not know becomes -1 and is scored nowhere."""
    tables: dict[tuple[str, ...], IntArray] = {}
    parts = [np.zeros(0, dtype=np.int64)]
    for record in records:
        names = record.class_names
        if names not in tables:
            ids = [KITTI_CLASSES.index(name) if name in KITTI_CLASSES else -1 for name in names]
            tables[names] = np.array(ids, dtype=np.int64)
        parts.append(tables[names][record.class_id])
    return np.concatenate(parts)


def _solids(records: Sequence[Objects3D] | Sequence[Detections3D]) -> FloatArray:
    center = _stack([record.center_in_camera for record in records], 3)
    size = _stack([record.size_hwl for record in records], 3)
    yaw = _stack([record.yaw_rad for record in records])
    half_height = 0.5 * size[:, 0]
    return np.column_stack(
        [
            center[:, 0],
            center[:, 2],
            size[:, 2],
            size[:, 1],
            yaw,
            center[:, 1] - half_height,
            center[:, 1] + half_height,
        ]
    )


def pair_table(labels: LabelTable, detections: DetectionTable) -> PairTable:
    """All overlaps between the two tables, frame by frame, in one pass."""
    label, detection = _same_frame_pairs(labels.frame, detections.frame, labels.frames)
    image = image_overlap(labels.box_in_left_image[label], detections.box_in_left_image[detection])
    bev, solid = solid_overlap(labels.solid[label], detections.solid[detection])
    keep = np.maximum(image, np.maximum(bev, solid)) >= LOWEST_OVERLAP
    region, covered = _same_frame_pairs(labels.region_frame, detections.frame, labels.frames)
    cover = np.zeros(len(detections.frame))
    share = image_overlap(labels.region_box[region], detections.box_in_left_image[covered], over_second=True)
    np.maximum.at(cover, covered, share)
    return PairTable(
        detection=detection[keep],
        label=label[keep],
        overlap={"2d": image[keep], "bev": bev[keep], "3d": solid[keep]},
        region_cover=cover,
    )


def _same_frame_pairs(first: IntArray, second: IntArray, frames: int) -> tuple[IntArray, IntArray]:
    """Every row of one sorted frame column with every row of the other in the same frame."""
    counts = np.bincount(second, minlength=frames)
    starts = np.concatenate([[0], np.cumsum(counts)])[:-1] if frames else np.zeros(0, dtype=np.int64)
    repeats = counts[first]
    left = np.repeat(np.arange(len(first)), repeats)
    within = np.arange(len(left)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    return left, starts[first][left] + within if len(left) else within


def image_overlap(first: FloatArray, second: FloatArray, *, over_second: bool = False) -> FloatArray:
    """2D overlap of paired boxes (N, 4) x1 y1 x2 y2: over the union, or over the area of ``second``; (N,)."""
    size = np.minimum(first[:, 2:], second[:, 2:]) - np.maximum(first[:, :2], second[:, :2])
    shared = np.where((size > 0).all(axis=1), size[:, 0] * size[:, 1], 0.0)
    second_area = (second[:, 2] - second[:, 0]) * (second[:, 3] - second[:, 1])
    first_area = (first[:, 2] - first[:, 0]) * (first[:, 3] - first[:, 1])
    whole = second_area if over_second else first_area + second_area - shared
    return np.divide(shared, whole, out=np.zeros_like(shared), where=shared > 0)


def solid_overlap(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Overlap of paired boxes, rows as in `LabelTable.solid`: on the ground plane (N,) and in space (N,)."""
    shared = intersection_areas(first[:, :5], second[:, :5])
    first_area, second_area = first[:, 2] * first[:, 3], second[:, 2] * second[:, 3]
    bev = np.divide(shared, first_area + second_area - shared, out=np.zeros_like(shared), where=shared > 0)
    height = np.minimum(first[:, 6], second[:, 6]) - np.maximum(first[:, 5], second[:, 5])
    volume = shared * np.maximum(height, 0.0)
    whole = first_area * (first[:, 6] - first[:, 5]) + second_area * (second[:, 6] - second[:, 5]) - volume
    return bev, np.divide(volume, whole, out=np.zeros_like(volume), where=volume > 0)


def distances_m(solid: FloatArray) -> FloatArray:
    """From the camera to the middle of solids, rows as in `LabelTable.solid`: (..., 7) to (...)."""
    height = 0.5 * (solid[..., 5] + solid[..., 6])
    distances: FloatArray = np.sqrt(solid[..., 0] ** 2 + solid[..., 1] ** 2 + height**2)
    return distances


def check_same_frames(labels: Sequence[Objects3D], detections: Sequence[Detections3D]) -> None:
    """Labels and detections must be records of the same frames, one each.

    Raises:
        FormatError: the two lists differ in length.
    """
    if len(labels) != len(detections):
        raise FormatError(
            f"labels cover {len(labels)} frames and detections {len(detections)}, expected the same frames; "
            "give one record a frame in both"
        )
