"""KITTI's text formats: labels, tracking labels, detections, calibration.

A label line: ``type truncation occlusion alpha x1 y1 x2 y2 h w l x y z rotation_y [score]`` with (x, y, z) the bottom
centre of the box; a tracking line has ``frame track_id`` in front. Our records hold the geometric centre, so reading
subtracts h / 2 from y and writing adds it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Detections3D, Objects3D

KITTI_CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Person_sitting", "Cyclist", "Tram", "Misc")
DONT_CARE = "DontCare"
MISSING_ALPHA_RAD = -10.0
_LABEL_FIELDS = 15
_TRACKING_PERSON = re.compile(r"^(\s*\d+\s+-?\d+)\s+Person\s+")  # the tracking set's name for Person_sitting
_TRACKING_TRUNCATION = re.compile(r"^(\s*\d+\s+-?\d+\s+\S+\s+)([12])\s+")
_SHARE_OF_LEVEL = {"1": "0.3", "2": "0.8"}


@dataclass(frozen=True, slots=True)
class _Row:
    kind: str
    numbers: tuple[float, ...]  # truncation .. rotation_y, then the score if there is one
    track_id: int = -1


def _parse_rows(lines: Iterable[str], *, where: str, lead: int, with_score: bool) -> list[_Row]:
    rows = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        body = words[lead:]
        wanted = _LABEL_FIELDS + (1 if with_score else 0)
        if len(body) < wanted or len(body) > _LABEL_FIELDS + 1:
            raise FormatError(
                f"{where} line {number} has {len(words)} fields, expected {wanted + lead}; "
                "it is not KITTI text of this kind"
            )
        try:
            rows.append(_Row(body[0], tuple(float(word) for word in body[1:]), int(words[1]) if lead else -1))
        except ValueError as error:
            raise FormatError(
                f"{where} line {number} holds {error}, expected numbers after the type; mend the file"
            ) from None
    return rows


def parse_labels(text: str, *, where: str = "label text") -> Objects3D:
    """Read an object label file; `class_names` of the result is `KITTI_CLASSES`, DontCare goes to its own boxes.

    Raises:
        FormatError: a line has missing fields, a word that is no number, or an unknown type.
    """
    return _objects(_parse_rows(text.splitlines(), where=where, lead=0, with_score=False), where)


def parse_tracking_labels(text: str, *, where: str = "tracking labels") -> dict[int, Objects3D]:
    """Read a tracking label file: frame number to its objects; frames without a line are absent.

    KITTI's own files give truncation by levels instead of a share: 0, 1 (partly) and 2 (largely). Level 1 is read as
    0.3, which is asked for from moderate on, level 2 as 0.8, which is not; numbers with a point are shares.
    """
    by_frame: dict[int, list[str]] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split(maxsplit=1)
        if not words:
            continue
        if not words[0].isdigit():
            raise FormatError(f"{where} line {number} starts with {words[0]!r}, expected a frame number; mend the file")
        by_frame.setdefault(int(words[0]), []).append(line)
    by_frame = {
        frame: [_TRACKING_TRUNCATION.sub(_share, _TRACKING_PERSON.sub(r"\1 Person_sitting ", line)) for line in lines]
        for frame, lines in by_frame.items()
    }
    return {
        frame: _objects(_parse_rows(lines, where=f"{where} frame {frame}", lead=2, with_score=False), where)
        for frame, lines in by_frame.items()
    }


def _share(level: re.Match[str]) -> str:
    return f"{level[1]}{_SHARE_OF_LEVEL[level[2]]} "


def _objects(rows: Sequence[_Row], where: str) -> Objects3D:
    regions = [row.numbers[3:7] for row in rows if row.kind == DONT_CARE]
    rows = [row for row in rows if row.kind != DONT_CARE]
    for row in rows:
        if row.kind not in KITTI_CLASSES:
            known = ", ".join((*KITTI_CLASSES, DONT_CARE))
            raise FormatError(f"{where} names the type {row.kind!r}, expected one of {known}; mend the file")
    if not rows:
        empty = Objects3D.empty(KITTI_CLASSES)
        return _with_regions(empty, np.array(regions, dtype=np.float64).reshape(-1, 4))
    table = np.array([row.numbers[:14] for row in rows], dtype=np.float64)
    return Objects3D(
        class_id=np.array([KITTI_CLASSES.index(row.kind) for row in rows]),
        box_in_left_image=table[:, 3:7],
        center_in_camera=_center_from_bottom(table[:, 10:13], table[:, 7]),
        size_hwl=table[:, 7:10],
        alpha_rad=table[:, 2],
        yaw_rad=table[:, 13],
        truncation=table[:, 0],
        occlusion=table[:, 1].astype(np.int64),
        track_id=np.array([row.track_id for row in rows]),
        dont_care_boxes=np.array(regions, dtype=np.float64).reshape(-1, 4),
        class_names=KITTI_CLASSES,
    )


def _with_regions(objects: Objects3D, regions: FloatArray) -> Objects3D:
    values = {name: getattr(objects, name) for name in objects.__dataclass_fields__}
    return Objects3D(**{**values, "dont_care_boxes": regions})


def _center_from_bottom(bottom: FloatArray, height_m: FloatArray) -> FloatArray:
    center = bottom.copy()
    center[:, 1] -= 0.5 * height_m
    return center


def parse_detections(
    text: str, class_names: tuple[str, ...] | None = None, *, where: str = "detections"
) -> Detections3D:
    """Read a result file (16 fields a line); an alpha of -10 means that the detector gave none and is kept as it is.

    Args:
        text: the file's text.
        class_names: names that ``class_id`` points into; None takes `KITTI_CLASSES`. Lines of other types are an error.
        where: name for messages.
    """
    names = class_names or KITTI_CLASSES
    rows = _parse_rows(text.splitlines(), where=where, lead=0, with_score=True)
    for row in rows:
        if row.kind not in names:
            raise FormatError(f"{where} names the type {row.kind!r}, expected one of {', '.join(names)}; mend the file")
    if not rows:
        return Detections3D.empty(names)
    table = np.array([row.numbers[:15] for row in rows], dtype=np.float64)
    return Detections3D(
        class_id=np.array([names.index(row.kind) for row in rows]),
        score=table[:, 14],
        box_in_left_image=table[:, 3:7],
        center_in_camera=_center_from_bottom(table[:, 10:13], table[:, 7]),
        size_hwl=table[:, 7:10],
        alpha_rad=table[:, 2],
        yaw_rad=table[:, 13],
        class_names=names,
    )


def format_detections(detections: Detections3D) -> str:
    """The official code's result lines: truncation and occlusion -1, six decimals, full score, one trailing space.

    Angles are written as the record holds them (decoding wraps them unless told to keep the official values).
    """
    lines = []
    bottom_m = detections.center_in_camera[:, 1].astype(np.float32)  # the official writer's sum is one in float32
    bottom_m += np.float32(0.5) * detections.size_hwl[:, 0].astype(np.float32)
    for row in range(len(detections)):
        name = detections.class_names[detections.class_id[row]]
        box = _box_text(detections, row, bottom_m=float(bottom_m[row]), decimals=6)
        lines.append(f"{name} -1 -1 {box} {float(detections.score[row])!r} \n")
    return "".join(lines)


def format_labels(objects: Objects3D, *, tracking_frame: int | None = None) -> str:
    """Object label lines, DontCare last; with ``tracking_frame`` the tracking layout (frame and track id in front)."""
    lines = []
    bottom_m = objects.center_in_camera[:, 1] + 0.5 * objects.size_hwl[:, 0]
    for row in range(len(objects)):
        lead = "" if tracking_frame is None else f"{tracking_frame} {objects.track_id[row]} "
        name = objects.class_names[objects.class_id[row]]
        seen = f"{objects.truncation[row]:.2f} {objects.occlusion[row]}"
        lines.append(f"{lead}{name} {seen} {_box_text(objects, row, bottom_m=bottom_m[row], decimals=4)}")
    for box in objects.dont_care_boxes:
        lead = "" if tracking_frame is None else f"{tracking_frame} -1 "
        pixels = " ".join(f"{value:.4f}" for value in box)
        lines.append(f"{lead}{DONT_CARE} -1 -1 -10 {pixels} -1 -1 -1 -1000 -1000 -1000 -10")
    return "".join(line + "\n" for line in lines)


def _box_text(boxes: Detections3D | Objects3D, row: int, *, bottom_m: float, decimals: int) -> str:
    """Alpha, 2D box, height, width, length, bottom centre and yaw of one row."""
    x, _, z = boxes.center_in_camera[row]
    height, width, length = boxes.size_hwl[row]
    pixels = boxes.box_in_left_image[row]
    numbers = [boxes.alpha_rad[row], *pixels, height, width, length, x, bottom_m, z, boxes.yaw_rad[row]]
    return " ".join(f"{value:.{decimals}f}" for value in numbers)


def parse_calib(text: str, image_size_wh: tuple[int, int], *, where: str = "calibration") -> StereoGeometry:
    """Read P2 and P3 of any KITTI calibration text (object, tracking, odometry: ``P2``; raw: ``P_rect_02``).

    Raises:
        FormatError: P2 or P3 is missing or malformed.
    """
    found: dict[str, FloatArray] = {}
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        name = {"P2": "P2", "P_rect_02": "P2", "P3": "P3", "P_rect_03": "P3"}.get(key.rstrip(":"))
        if name is None:
            continue
        try:
            values = np.array([float(word) for word in rest.split()], dtype=np.float64)
        except ValueError as error:
            raise FormatError(f"{where}: {name} holds {error}, expected 12 numbers; mend the file") from None
        if values.size != 12:
            raise FormatError(f"{where}: {name} has {values.size} numbers, expected 12; mend the file")
        found[name] = values.reshape(3, 4)
    missing = [name for name in ("P2", "P3") if name not in found]
    if missing:
        raise FormatError(
            f"{where} has no {' and no '.join(missing)}, expected lines P2 and P3 of 12 numbers each; "
            "give the calibration of the rectified colour cameras"
        )
    return StereoGeometry(found["P2"], found["P3"], image_size_wh)


def format_calib(geometry: StereoGeometry) -> str:
    """Calibration text in the object layout; P0 and P1 repeat P2 and P3, rectification is the identity."""
    identity = np.eye(3, 3)
    rigid = np.eye(3, 4)
    rows = [("P0", geometry.P2), ("P1", geometry.P3), ("P2", geometry.P2), ("P3", geometry.P3)]
    rows += [("R0_rect", identity), ("Tr_velo_to_cam", rigid), ("Tr_imu_to_velo", rigid)]
    return "".join(f"{name}: " + " ".join(f"{value:.12e}" for value in matrix.ravel()) + "\n" for name, matrix in rows)
