"""Objects cut out of labelled stereo pairs, both views, to be pasted elsewhere.

The bank knows from the labels alone which objects are whole and plain to see, and takes some of each source and class;
pixels are cut when one is first asked for, and kept. A cut is a function of its frame alone, and what is drawn does not
depend on what was drawn before, so that runs can be repeated and resumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.training.disparity_targets import grey_of
from edge.training.ground_truth import with_every_alpha
from edge.training.object_masks import ViewMask, agreed_mask, disparity_at, look_for_object
from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Objects3D, box_corners
from runtime.sources.base import FrameSequence

MIN_HEIGHT_PX, MAX_HEIGHT_PX = 36.0, 260.0
DEPTH_LIMITS_M = (4.5, 32.0)
BORDER_PX = 3.0
MAX_COVERED_SHARE = 0.02  # by the 2D box of a nearer object
MIN_OUTLINE_IOU = 0.7  # of the mask's bounding box and the label's
MIN_AGREEMENT = 0.68  # share of the mask that three of four votes are for
MAX_FILL = 0.78  # share of a person's box: beyond, what is around came along
MIN_TEXTURE = 12.0  # standard deviation of grey levels inside
MEMBERS = 60  # of a class in a source
NEIGHBOURS_TRIED = 6  # where one cannot be cut out cleanly


@dataclass(frozen=True, slots=True)
class ViewCut:
    """An object's pixels in one view.

    Attributes:
        corner_xy: column and row of the window in the view that it was cut from.
        image: (h, w, 3) uint8 BGR.
        opacity: (h, w) float32.
    """

    corner_xy: tuple[int, int]
    image: NDArray[np.uint8]
    opacity: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ObjectCut:
    """An object cut out of a pair.

    Attributes:
        class_name: of its label.
        left, right: its pixels.
        box_in_left_image, center_in_camera, size_hwl, alpha_rad: of its label.
        geometry: of the pair.
        surroundings_bgr: (3,) mean colour around it.
    """

    class_name: str
    left: ViewCut
    right: ViewCut
    box_in_left_image: FloatArray
    center_in_camera: FloatArray
    size_hwl: FloatArray
    alpha_rad: float
    geometry: StereoGeometry
    surroundings_bgr: FloatArray


class ObjectBank:
    """Objects of labelled sequences by class.

    Args:
        sources: stereo sequences; those of other rigs than the frames pasted into are found out when placing.
        classes: which objects.
    """

    def __init__(self, sources: Sequence[FrameSequence], classes: Sequence[str]) -> None:
        self._sources = list(sources)
        self._members: dict[str, list[list[tuple[int, int]]]] = {name: [[] for _ in sources] for name in classes}
        self._cuts: dict[tuple[int, int, int], ObjectCut | None] = {}
        for index, source in enumerate(self._sources):
            for row in range(len(source)):
                objects = source.labels(row)
                if objects is None:
                    continue
                for item in plain_objects(objects):
                    name = objects.class_names[objects.class_id[item]]
                    if name in self._members:
                        self._members[name][index].append((row, int(item)))
        for of_class in self._members.values():
            of_class[:] = [rows[:: -(-len(rows) // MEMBERS)] if rows else rows for rows in of_class]

    @property
    def classes(self) -> tuple[str, ...]:
        """Classes of which there is an object."""
        return tuple(name for name, rows in self._members.items() if any(rows))

    def count(self, class_name: str) -> int:
        """Objects of a class that may be cut out."""
        return sum(len(rows) for rows in self._members[class_name])

    def draw(self, class_name: str, rng: np.random.Generator) -> ObjectCut | None:
        """An object of a class: each source that has some is as likely, so that few real ones weigh as much.

        Returns:
            None where there is none, or neither the one drawn nor its neighbours can be cut out cleanly.
        """
        holders = [index for index, rows in enumerate(self._members[class_name]) if rows]
        if not holders:
            return None
        source_index = holders[rng.integers(len(holders))]
        rows = self._members[class_name][source_index]
        first = int(rng.integers(len(rows)))
        for step in range(min(NEIGHBOURS_TRIED, len(rows))):
            key = (source_index, *rows[(first + step) % len(rows)])
            if key not in self._cuts:
                self._cuts[key] = self._cut(*key)
            if self._cuts[key] is not None:
                return self._cuts[key]
        return None

    def _cut(self, source_index: int, row: int, item: int) -> ObjectCut | None:
        source = self._sources[source_index]
        objects = source.labels(row)
        frame = source[row]
        if objects is None or frame.right is None:
            return None
        return cut_out(frame.left, frame.right, geometry=frame.geometry, objects=objects, row=item)


def plain_objects(objects: Objects3D) -> NDArray[np.int64]:
    """Rows of objects that are whole, unhidden, near enough and not too near, as far as labels tell."""
    boxes, depth_m = objects.box_in_left_image, objects.center_in_camera[:, 2]
    height = boxes[:, 3] - boxes[:, 1]
    good = (
        (objects.occlusion == 0)
        & (objects.truncation <= 0.0)
        & (height >= MIN_HEIGHT_PX)
        & (height <= MAX_HEIGHT_PX)
        & (depth_m >= DEPTH_LIMITS_M[0])
        & (depth_m <= DEPTH_LIMITS_M[1])
        & (boxes[:, :2].min(axis=1, initial=np.inf) >= BORDER_PX)
    )
    rows = [row for row in np.flatnonzero(good) if _covered_share(objects, int(row)) <= MAX_COVERED_SHARE]
    return np.array(rows, np.int64)


def cut_out(
    left: NDArray[np.uint8], right: NDArray[np.uint8], *, geometry: StereoGeometry, objects: Objects3D, row: int
) -> ObjectCut | None:
    """Cut one object out of both views; None where its pixels cannot be told from what is around.

    Args:
        left, right: (H, W, 3) uint8 BGR.
        geometry: of the pair.
        objects: labels.
        row: which of them.
    """
    box = objects.box_in_left_image[row]
    size_wh = geometry.image_size_wh
    box_in_right = _box_in_right(objects, row, geometry)
    if box[2] > size_wh[0] - BORDER_PX or box[3] > size_wh[1] - BORDER_PX or box_in_right[0] < BORDER_PX:
        return None
    grey = [grey_of(image) for image in (left, right)]
    name = objects.class_names[objects.class_id[row]]
    shown = {"geometry": geometry, "objects": objects, "row": row, "without_ground": name != "Car"}
    evidence = [
        look_for_object(grey[0], grey[1], picture=left, box=box, **shown),  # type: ignore[arg-type]
        look_for_object(grey[1], grey[0], picture=right, box=box_in_right, right=True, **shown),  # type: ignore[arg-type]
    ]
    if evidence[0] is None or evidence[1] is None:
        return None
    left_mask = agreed_mask(evidence[0], evidence[1])
    right_mask = agreed_mask(evidence[1], evidence[0], right=True)
    if left_mask is None or right_mask is None or _outline_iou(left_mask, box) < MIN_OUTLINE_IOU:
        return None
    if name != "Car" and left_mask.opacity.sum() > MAX_FILL * (box[2:] - box[:2]).prod():
        return None
    inside = _window(grey[0], left_mask)[left_mask.opacity > 0.5]
    if min(left_mask.agreement, right_mask.agreement) < MIN_AGREEMENT or inside.std() < MIN_TEXTURE:
        return None
    around = _window(left, left_mask)[left_mask.opacity < 0.05]
    return ObjectCut(
        class_name=name,
        left=_view_cut(left, left_mask),
        right=_view_cut(right, right_mask),
        box_in_left_image=box,
        center_in_camera=objects.center_in_camera[row],
        size_hwl=objects.size_hwl[row],
        alpha_rad=float(with_every_alpha(objects, geometry.P2).alpha_rad[row]),
        geometry=geometry,
        surroundings_bgr=around.mean(axis=0) if len(around) else np.full(3, 96.0),
    )


def _box_in_right(objects: Objects3D, row: int, geometry: StereoGeometry) -> FloatArray:
    """(4,) the labelled box moved by the disparities of the object's near and far side."""
    corners = box_corners(objects.center_in_camera, objects.size_hwl, objects.yaw_rad)[row]
    disparity_px = disparity_at(geometry, corners[:, 2] + geometry.P2[2, 3])
    box = objects.box_in_left_image[row]
    middle, reach = (disparity_px.min() + disparity_px.max()) / 2, (disparity_px.max() - disparity_px.min()) / 4
    return box - [middle + reach, 0.0, middle - reach, 0.0]


def _window(image: NDArray[np.uint8], mask: ViewMask) -> NDArray[np.uint8]:
    (x, y), (height, width) = mask.corner_xy, mask.opacity.shape
    return image[y : y + height, x : x + width]


def _view_cut(image: NDArray[np.uint8], mask: ViewMask) -> ViewCut:
    return ViewCut(mask.corner_xy, _window(image, mask).copy(), mask.opacity)


def _outline_iou(mask: ViewMask, box: FloatArray) -> float:
    x, y, width, height = cv2.boundingRect((mask.opacity > 0.5).astype(np.uint8))
    x1, y1 = mask.corner_xy[0] + x, mask.corner_xy[1] + y
    columns = min(x1 + width, box[2]) - max(x1, box[0])
    rows = min(y1 + height, box[3]) - max(y1, box[1])
    overlap = max(columns, 0.0) * max(rows, 0.0)
    return float(overlap / (width * height + (box[2] - box[0]) * (box[3] - box[1]) - overlap + 1e-9))


def _covered_share(objects: Objects3D, row: int) -> float:
    """Largest share of an object's box under that of a nearer one."""
    box = objects.box_in_left_image[row]
    nearer = objects.box_in_left_image[objects.center_in_camera[:, 2] < objects.center_in_camera[row, 2]]
    if not len(nearer):
        return 0.0
    extent = np.minimum(nearer[:, 2:], box[2:]) - np.maximum(nearer[:, :2], box[:2])
    overlap = np.maximum(extent, 0.0).prod(axis=1)
    return float(overlap.max() / (box[2:] - box[:2]).prod())
