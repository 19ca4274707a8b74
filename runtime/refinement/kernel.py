"""`runtime.refinement.refine_depths` by the native library (``refine.h``): the same depths, many times as fast."""

from __future__ import annotations

import ctypes
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Detections3D
from runtime.native.library import RecordCall, record_call
from runtime.refinement import evidence as evidence_rules
from runtime.refinement import matching, mismatch, occluders, samples, surface
from runtime.refinement.depth import image_rows, refine_depths
from runtime.refinement.evidence import UNSEARCHED, Refined
from runtime.refinement.matching import Pixels, normalised

RefineDepths = Callable[[Detections3D, Pixels, Pixels, StereoGeometry], Refined]

_SYMBOL = "EdgeRefineDepths"
_DOUBLE, _INT = ctypes.c_double, ctypes.c_int64


_NUMBERS = {
    "vehicle_margins": 3,
    "person_margins": 3,
    "smallest_box_px": 2,
    "body_shares": 2,
    "cabin_shares": 2,
    "belt_share": 1,
    "occluder_score": 1,
    "nearer_by_m": 1,
    "same_object_iou": 1,
    "inset_share": 1,
    "least_seen_share": 1,
    "vehicle_saturation": 1,
    "person_saturation": 1,
    "trusted_share": 1,
    "least_patch_share": 1,
    "range_px": 1,
    "range_share": 1,
    "prior_per_px2": 1,
    "prior_limit_px2": 1,
    "least_disparity_px": 1,
    "no_match": 1,
    "elsewhere_px": 1,
    "most_difference": 1,
    "most_shift_px": 1,
}
_COUNTS = ("most_columns", "most_rows", "fewest", "patch_rows", "patch_columns", "coarse_steps", "fine_steps")
_RULES_OF = (surface, occluders, samples, mismatch, matching, evidence_rules)
"""The modules whose constants are the rules, each by its field's name in capitals."""


class _Rules(ctypes.Structure):
    """``edge::RefineRules``."""

    _fields_ = (
        *((name, _DOUBLE * length) for name, length in _NUMBERS.items()),
        *((name, _INT) for name in _COUNTS),
    )


class _Frame(ctypes.Structure):
    """``edge::RefineFrame``."""

    _fields_ = (
        ("left", ctypes.c_void_p),
        ("right", ctypes.c_void_p),
        ("height", _INT),
        ("width", _INT),
        ("first_row", _INT),
        ("image_height", _INT),
        ("box_count", _INT),
        ("boxes", ctypes.c_void_p),
        ("size_hwl", ctypes.c_void_p),
        ("yaw_rad", ctypes.c_void_p),
        ("score", ctypes.c_void_p),
        ("solid", ctypes.c_void_p),
        ("order", ctypes.c_void_p),
        ("centers", ctypes.c_void_p),
        ("evidence", ctypes.c_void_p),
        ("focal_px", _DOUBLE),
        ("principal_column_px", _DOUBLE),
        ("focal_baseline", _DOUBLE),
        ("offset_px", _DOUBLE),
        ("shift_m", _DOUBLE * 2),
    )


def refiner(*, use_native: bool = True) -> RefineDepths:
    """The fastest `refine_depths` that there is: the library's; in NumPy where that is not built or not wanted."""
    call = record_call(_SYMBOL) if use_native else None
    if call is None:
        return refine_depths
    rules = _rules()

    def refine(found: Detections3D, left: Pixels, right: Pixels, geometry: StereoGeometry) -> Refined:
        evidence = np.tile(UNSEARCHED, (len(found), 1))
        if len(found) == 0:
            return Refined(found, evidence)
        centers = _refined_centers(call, rules, found, left, right, geometry, evidence=evidence)
        if centers is None:
            return refine_depths(found, left, right, geometry)
        return Refined(dataclasses.replace(found, center_in_camera=centers), evidence)

    return refine


def _refined_centers(
    call: RecordCall,
    rules: _Rules,
    found: Detections3D,
    left: Pixels,
    right: Pixels,
    geometry: StereoGeometry,
    *,
    evidence: NDArray[np.float64],
) -> NDArray[np.float64] | None:
    """(N, 3) metres, and ``evidence`` is filled in; None where the library is of another build than this file."""
    first, last = image_rows(found, left.shape[0])
    views = [np.ascontiguousarray(normalised(image[first:last])) for image in (left, right)]
    centers = np.array(found.center_in_camera, np.float64)
    solid = np.array([name in surface.VEHICLES for name in found.class_names], np.uint8)[found.class_id]
    order = np.argsort(centers[:, 2], kind="stable").astype(np.int64)
    columns: list[NDArray[Any]] = [
        np.ascontiguousarray(item) for item in (found.box_in_left_image, found.size_hwl, found.yaw_rad)
    ]
    columns += [np.ascontiguousarray(found.score), solid, order]
    P2, P3 = geometry.P2, geometry.P3
    frame = _Frame(
        *(view.ctypes.data for view in views),
        *views[0].shape,
        first,
        left.shape[0],
        len(found),
        *(item.ctypes.data for item in columns),
        centers.ctypes.data,
        evidence.ctypes.data,
        P2[0, 0],
        P2[0, 2],
        P2[0, 3] - P3[0, 3],
        P2[0, 2] - P3[0, 2],
        (_DOUBLE * 2)(*geometry.to_left_camera_m[:2]),
    )
    return centers if call(frame, rules) else None


def _rules() -> _Rules:
    constants = {name: value for module in _RULES_OF for name, value in vars(module).items() if name.isupper()}
    numbers = [(_DOUBLE * length)(*np.atleast_1d(constants[name.upper()])) for name, length in _NUMBERS.items()]
    return _Rules(*numbers, *(constants[name.upper()] for name in _COUNTS))
