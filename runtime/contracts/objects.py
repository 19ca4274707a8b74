"""3D boxes as structs of arrays: what the detector finds (`Detections3D`) and what the labels say (`Objects3D`).

Frame: the labels' rectified reference camera, x right, y down, z forward, metres; P2 maps it to left pixels. The
centre is the geometric centre of the box (KITTI text holds the bottom centre: y + h / 2). Yaw turns about y.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import FloatArray

IntArray = NDArray[np.int64]
TWO_PI = 2.0 * np.pi


def wrap_angle_rad(angle_rad: FloatArray) -> FloatArray:
    """Wrap to [-pi, pi)."""
    wrapped: FloatArray = (np.asarray(angle_rad, dtype=np.float64) + np.pi) % TWO_PI - np.pi
    return np.where(wrapped >= np.pi, -np.pi, wrapped)  # the modulo of a tiny negative can round up to 2 pi


def _set_checked(record: Any, shapes: dict[str, tuple[int, ...]], integers: tuple[str, ...]) -> None:
    count = len(np.atleast_1d(record.class_id))
    for name, tail in shapes.items():
        array = np.array(getattr(record, name), dtype=np.int64 if name in integers else np.float64)
        if array.size == 0:
            array = array.reshape(0, *tail)
        if array.shape != (count, *tail):
            raise FormatError(f"{name} has shape {array.shape}, expected {(count, *tail)}; give one row a box")
        if not np.isfinite(array).all():
            raise FormatError(f"{name} holds a value that is not finite; drop such boxes before")
        array.setflags(write=False)
        object.__setattr__(record, name, array)


_BOX_SHAPES: dict[str, tuple[int, ...]] = {
    "class_id": (),
    "box_in_left_image": (4,),
    "center_in_camera": (3,),
    "size_hwl": (3,),
    "alpha_rad": (),
    "yaw_rad": (),
}


class _BoxTable:
    """Row selection shared by both records."""

    __slots__ = ()

    def select(self, rows: NDArray[Any] | slice) -> Self:
        """The same record with the given rows (index array, boolean mask, or slice)."""
        values: dict[str, Any] = {}
        for item in fields(self):  # type: ignore[arg-type]
            value = getattr(self, item.name)
            values[item.name] = value[rows] if item.name in self._row_fields() else value
        return type(self)(**values)

    @classmethod
    def _row_fields(cls) -> tuple[str, ...]:
        raise NotImplementedError


@dataclass(frozen=True, slots=True)
class Detections3D(_BoxTable):
    """N detected boxes, sorted by falling score.

    Attributes:
        class_id: (N,) int64, index into ``class_names``.
        score: (N,) in [0, 1].
        box_in_left_image: (N, 4) x1 y1 x2 y2 in pixels of the original left image.
        center_in_camera: (N, 3) metres, geometric centre.
        size_hwl: (N, 3) metres.
        alpha_rad: (N,) observation angle.
        yaw_rad: (N,) rotation about y.
        class_names: names that ``class_id`` points into.

    Raises:
        FormatError: shapes differ, a value is not finite, a class is out of range.
    """

    class_id: IntArray
    score: FloatArray
    box_in_left_image: FloatArray
    center_in_camera: FloatArray
    size_hwl: FloatArray
    alpha_rad: FloatArray
    yaw_rad: FloatArray
    class_names: tuple[str, ...]

    def __post_init__(self) -> None:
        _set_checked(self, {**_BOX_SHAPES, "score": ()}, ("class_id",))
        _check_classes(self.class_id, self.class_names)
        if np.any(np.diff(self.score) > 0):
            order = np.argsort(-self.score, kind="stable")
            for name in self._row_fields():
                array = getattr(self, name)[order]
                array.setflags(write=False)
                object.__setattr__(self, name, array)

    @classmethod
    def _row_fields(cls) -> tuple[str, ...]:
        return (*_BOX_SHAPES, "score")

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> Detections3D:
        """No box at all."""
        none = np.zeros(0)
        return cls(none, none, np.zeros((0, 4)), np.zeros((0, 3)), np.zeros((0, 3)), none, none, class_names)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.class_id)

    def above(self, score: float) -> Detections3D:
        """Only the boxes with at least this score."""
        return self.select(self.score >= score)


@dataclass(frozen=True, slots=True)
class Objects3D(_BoxTable):
    """N labelled boxes of one frame.

    Attributes:
        class_id, box_in_left_image, center_in_camera, size_hwl, alpha_rad, yaw_rad: as in `Detections3D`.
        truncation: (N,) share of the object outside the image, 0 to 1.
        occlusion: (N,) int64, 0 visible, 1 partly, 2 largely occluded, 3 unknown.
        track_id: (N,) int64, -1 where the labels have none.
        dont_care_boxes: (M, 4) x1 y1 x2 y2 pixels: regions in which detections are neither right nor wrong.
        class_names: names that ``class_id`` points into.
    """

    class_id: IntArray
    box_in_left_image: FloatArray
    center_in_camera: FloatArray
    size_hwl: FloatArray
    alpha_rad: FloatArray
    yaw_rad: FloatArray
    truncation: FloatArray
    occlusion: IntArray
    track_id: IntArray
    dont_care_boxes: FloatArray
    class_names: tuple[str, ...]

    def __post_init__(self) -> None:
        _set_checked(
            self,
            {**_BOX_SHAPES, "truncation": (), "occlusion": (), "track_id": ()},
            ("class_id", "occlusion", "track_id"),
        )
        _check_classes(self.class_id, self.class_names)
        regions = np.array(self.dont_care_boxes, dtype=np.float64).reshape(-1, 4)
        regions.setflags(write=False)
        object.__setattr__(self, "dont_care_boxes", regions)

    @classmethod
    def _row_fields(cls) -> tuple[str, ...]:
        return (*_BOX_SHAPES, "truncation", "occlusion", "track_id")

    @classmethod
    def empty(cls, class_names: tuple[str, ...]) -> Objects3D:
        """No object at all."""
        none = np.zeros(0)
        boxes = np.zeros((0, 4))
        triples = np.zeros((0, 3))
        return cls(none, boxes, triples, triples, none, none, none, none, none, boxes, class_names)  # type: ignore[arg-type]

    def __len__(self) -> int:
        return len(self.class_id)


def _check_classes(class_id: IntArray, class_names: tuple[str, ...]) -> None:
    if class_id.size and (class_id.min() < 0 or class_id.max() >= len(class_names)):
        raise FormatError(f"class ids reach {class_id.min()}..{class_id.max()}, expected 0..{len(class_names) - 1}")


# Corner signs along (length, height, width), the official order: x_l is width, y_l height, z_l length there.
_CORNER_SIGNS = np.array(
    [[-1, -1, -1], [1, -1, -1], [1, 1, -1], [1, 1, 1], [1, -1, 1], [-1, -1, 1], [-1, 1, 1], [-1, 1, -1]],
    dtype=np.float64,
)


def box_corners(center: FloatArray, size_hwl: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """The eight corners of each box.

    Local axes (x along width, y along height, z along length), in the official code's corner order; then
    ``x' = z_l cos(yaw) + x_l sin(yaw)``, ``z' = -z_l sin(yaw) + x_l cos(yaw)``.

    Args:
        center: (N, 3) metres, geometric centres.
        size_hwl: (N, 3) metres.
        yaw_rad: (N,) radians.

    Returns:
        (N, 8, 3) metres in the camera frame.
    """
    half = 0.5 * size_hwl[:, None, :]
    x_local = _CORNER_SIGNS[None, :, 0] * half[..., 1]
    y_local = _CORNER_SIGNS[None, :, 1] * half[..., 0]
    z_local = _CORNER_SIGNS[None, :, 2] * half[..., 2]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    turned = np.stack([z_local * cos + x_local * sin, y_local, -z_local * sin + x_local * cos], axis=-1)
    return turned + center[:, None, :]


_GROUND_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])  # along length, along width


def ground_corners(center_xz: FloatArray, size_lw: FloatArray, yaw_rad: FloatArray) -> FloatArray:
    """The four corners of each box seen from above: front left, front right, rear right, rear left.

    ``x' = x + a cos(yaw) + b sin(yaw)``, ``z' = z - a sin(yaw) + b cos(yaw)`` with a along the length, b along the
    width: KITTI's yaw turns x towards -z.

    Args:
        center_xz: (N, 2) metres.
        size_lw: (N, 2) metres, length and width.
        yaw_rad: (N,) radians.

    Returns:
        (N, 4, 2) x and z in metres in the camera frame.
    """
    along = 0.5 * _GROUND_SIGNS[None, :, 0] * size_lw[:, None, 0]
    across = 0.5 * _GROUND_SIGNS[None, :, 1] * size_lw[:, None, 1]
    cos, sin = np.cos(yaw_rad)[:, None], np.sin(yaw_rad)[:, None]
    turned = np.stack([along * cos + across * sin, -along * sin + across * cos], axis=-1)
    return turned + center_xz[:, None, :]
