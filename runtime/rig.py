"""Camera rigs: geometry files, and how far a rig may be from the one that a model was trained on.

Three kinds of geometry file are read: KITTI calibration text (P2, P3, or raw's P_rect_02, P_rect_03), our
JSON ``{"schema": 1, "image_size_wh": [w, h], "P2": 3x4, "P3": 3x4}``, and a depthai calibration
(`runtime.depthai_rig`).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from runtime.contracts.errors import FormatError, RigError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_calib
from runtime.contracts.manifest import RigLimits
from runtime.depthai_rig import parse_depthai_calibration
from runtime.known_rigs import with_known_offset

SCHEMA = 1
_KEYS = ("schema", "image_size_wh", "P2", "P3")
SIZE_SLACK_PX = 1.0
"""A resized height may be off by rounding."""
SILENT_SHARE, TOLERATED_SHARE = 0.05, 0.25
"""Differences of focal length or baseline: up to the first silently, up to the second with a warning."""
SILENT_SHIFT_PX, TOLERATED_SHIFT_PX = 1.0, 4.0
"""The same of the distance between the views' principal points, in network pixels; the finest volume has cells of 4."""


def load_geometry(path: Path | str, image_size_wh: tuple[int, int] | None = None) -> StereoGeometry:
    """The geometry of a file for images of a given size.

    A file that names its size is scaled to another size of the same shape (a depthai calibration also to
    another shape, see there); KITTI text of the object, tracking and odometry kind names none and is taken
    as it is.

    Args:
        path: the file.
        image_size_wh: of the images; None takes the size that the file names.

    Raises:
        FormatError: the file is missing, of no known kind, lacks P2 or P3, or is for images of another shape.
    """
    where = str(path)
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise FormatError(
            f"geometry {where} cannot be read ({error.strerror}), expected a calibration file; check the path"
        ) from error
    except UnicodeDecodeError:
        raise FormatError(
            f"geometry {where} is no text, expected KITTI calibration text or JSON; check the path"
        ) from None
    if not text.lstrip().startswith("{"):
        return _from_kitti_text(text, image_size_wh, where=where)
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise FormatError(
            f"{where} is no JSON ({error.msg} at line {error.lineno}), expected a geometry file; mend the file"
        ) from None
    if "cameraData" in data:
        return parse_depthai_calibration(data, image_size_wh, where=where)
    return fit_to_size(parse_geometry(data, where=where), image_size_wh, where=where)


def parse_geometry(data: dict[str, Any], *, where: str = "geometry") -> StereoGeometry:
    """Our JSON, taken strictly.

    Raises:
        FormatError: a key is missing or unknown, the schema is another, a value does not fit.
    """
    if set(data) != set(_KEYS):
        raise FormatError(
            f"{where} has the keys {', '.join(sorted(data)) or 'none'}, expected {', '.join(_KEYS)}; "
            "P2 and P3 are 3 rows of 4 numbers"
        )
    if data["schema"] != SCHEMA or isinstance(data["schema"], bool):
        raise FormatError(f"{where} has schema {data['schema']!r}, expected {SCHEMA}; write it anew")
    size = data["image_size_wh"]
    if not (isinstance(size, list) and len(size) == 2 and all(type(side) is int and side > 0 for side in size)):
        raise FormatError(f"{where}: image_size_wh is {size!r}, expected two whole numbers; mend the file")
    try:
        P2, P3 = (np.array(data[name], dtype=np.float64) for name in ("P2", "P3"))
    except (TypeError, ValueError):
        raise FormatError(f"{where}: P2 or P3 is no table of numbers, expected 3 rows of 4; mend the file") from None
    try:
        return StereoGeometry(P2, P3, (size[0], size[1]))
    except FormatError as error:
        raise FormatError(f"{where}: {error}") from None


def format_geometry(geometry: StereoGeometry) -> str:
    """Our JSON text of a geometry."""
    data = {
        "schema": SCHEMA,
        "image_size_wh": list(geometry.image_size_wh),
        "P2": geometry.P2.tolist(),
        "P3": geometry.P3.tolist(),
    }
    return json.dumps(data, indent=2) + "\n"


def fit_to_size(geometry: StereoGeometry, image_size_wh: tuple[int, int] | None, *, where: str) -> StereoGeometry:
    """The geometry for resized images of the same shape.

    Raises:
        FormatError: the shape is another, so that something was cut and not only resized.
    """
    if image_size_wh is None or geometry.image_size_wh == image_size_wh:
        return geometry
    factor_xy = (
        image_size_wh[0] / geometry.image_size_wh[0],
        image_size_wh[1] / geometry.image_size_wh[1],
    )
    if abs(factor_xy[0] * geometry.image_size_wh[1] - image_size_wh[1]) > SIZE_SLACK_PX:
        raise FormatError(
            f"{where} is for {_size(geometry.image_size_wh)} images, found {_size(image_size_wh)}, expected "
            "that size or one of the same shape; give the geometry of these images"
        )
    return geometry.scale(factor_xy, image_size_wh)


def check_rig(network_geometry: StereoGeometry, rig: RigLimits, *, stereo: bool, allow: bool) -> str | None:
    """Compares a camera, as the network sees it, with the cameras of the training data.

    Args:
        network_geometry: of the network image.
        rig: of the model.
        stereo: whether baseline and the two views' alignment matter.
        allow: whether a rig beyond all tolerance is accepted (with a warning).

    Returns:
        None where the rig fits, else a warning to show once.

    Raises:
        RigError: it is too far off and not allowed.
    """
    differences = [_relative("focal length", network_geometry.focal_px, rig.focal_px, "network px")]
    if stereo:
        P2, P3 = network_geometry.P2, network_geometry.P3
        differences += [
            _relative("baseline", network_geometry.baseline_m, rig.baseline_m, "m"),
            _shift("columns", float(P2[0, 2] - P3[0, 2])),
            _shift("rows", float(P2[1, 2] - P3[1, 2])),
        ]
    worst = max((item for item in differences if not item.is_silent), key=lambda item: item.of_tolerated, default=None)
    if worst is None:
        return None
    if worst.of_tolerated <= 1.0:
        return f"rig: {worst.facts}; distances may suffer, {worst.remedy} would be better"
    if allow:
        return f"rig: {worst.facts}; accepted because another rig was allowed, expect wrong distances"
    raise RigError(f"rig: {worst.facts}, expected at most {worst.limit}; use {worst.remedy}, or pass --allow-other-rig")


@dataclass(frozen=True, slots=True)
class _Difference:
    """One way in which a camera is not what the model knows.

    Attributes:
        facts: in words; limit: what is tolerated; remedy: what to use instead.
        is_silent: too small to speak of.
        of_tolerated: share of what is tolerated.
    """

    facts: str
    limit: str
    remedy: str
    is_silent: bool
    of_tolerated: float


def _relative(name: str, found: float, wanted: float, unit: str) -> _Difference:
    share = abs(found / wanted - 1.0)
    return _Difference(
        f"{name} is {found:.4g} {unit}, the model was made for {wanted:.4g} {unit} ({share:.0%} off)",
        f"{TOLERATED_SHARE:.0%}",
        "a model trained for this rig",
        share <= SILENT_SHARE,
        share / TOLERATED_SHARE,
    )


def _shift(axis: str, shift_px: float) -> _Difference:
    """Rectified views look one way: a shift of their principal points adds to all disparities, or parts the rows."""
    return _Difference(
        f"the views' principal {axis} are {abs(shift_px):.3g} network px apart",
        f"{TOLERATED_SHIFT_PX:g}",
        "a pair that is rectified to one principal point",
        abs(shift_px) <= SILENT_SHIFT_PX,
        abs(shift_px) / TOLERATED_SHIFT_PX,
    )


def _from_kitti_text(text: str, image_size_wh: tuple[int, int] | None, *, where: str) -> StereoGeometry:
    named = _raw_size(text)
    if named is None and image_size_wh is None:
        raise FormatError(
            f"{where} names no image size, expected S_rect_02 or a JSON geometry; give the size with the images"
        )
    size = named or image_size_wh
    assert size is not None
    geometry = with_known_offset(parse_calib(text, size, where=where), text)
    return fit_to_size(geometry, image_size_wh, where=where)


def _raw_size(text: str) -> tuple[int, int] | None:
    """Rectified image size of a raw drive's calibration (``S_rect_02: 1.242000e+03 3.750000e+02``)."""
    for line in text.splitlines():
        key, _, rest = line.partition(":")
        words = rest.split()
        if key.strip() == "S_rect_02" and len(words) == 2:
            try:
                return round(float(words[0])), round(float(words[1]))
            except ValueError:
                return None
    return None


def _size(size_wh: tuple[int, int]) -> str:
    return f"{size_wh[0]}x{size_wh[1]}"
