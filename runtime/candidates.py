"""Suppression and votes by the native library (``candidates.h``): the same boxes, many times as fast.

Where the library is not built or not wanted, `runtime.nms` and `runtime.voting` do it in NumPy; they are its oracles.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.boxcode import ALPHA, FloatArray32
from runtime.contracts.geometry import FloatArray
from runtime.native.library import RecordCall, record_call
from runtime.nms import non_maximum_suppression
from runtime.voting import LEAST_SCORE_SHARE, NEAR_ANGLE_RAD, NEAR_DEPTH_SHARE, voted_boxes

_COLUMNS = ALPHA + 1
_DOUBLE, _INT, _ADDRESS = ctypes.c_double, ctypes.c_int64, ctypes.c_void_p


@dataclass(frozen=True, slots=True)
class Thinning:
    """How a frame's candidates become one box an object.

    Attributes:
        suppress: as `runtime.nms.non_maximum_suppression`.
        vote: as `runtime.voting.voted_boxes`.
    """

    suppress: Callable[..., NDArray[np.int64]] = non_maximum_suppression
    vote: Callable[..., FloatArray32] = voted_boxes


class _SuppressionFrame(ctypes.Structure):
    """``edge::SuppressionFrame``."""

    _fields_ = (
        ("boxes", _ADDRESS),
        ("group", _ADDRESS),
        ("depth", _ADDRESS),
        ("count", _INT),
        ("iou", _DOUBLE),
        ("depth_share", _DOUBLE),
        ("alive", _ADDRESS),
    )


class _VotingFrame(ctypes.Structure):
    """``edge::VotingFrame``."""

    _fields_ = (
        ("boxes", _ADDRESS),
        ("score", _ADDRESS),
        ("class_id", _ADDRESS),
        ("keep", _ADDRESS),
        ("count", _INT),
        ("kept_count", _INT),
        ("iou", _DOUBLE),
        ("least_score_share", _DOUBLE),
        ("near_depth_share", _DOUBLE),
        ("near_angle_rad", _DOUBLE),
        ("means", _ADDRESS),
    )


def thinning(*, use_native: bool = True) -> Thinning:
    """The fastest that there is."""
    if not use_native:
        return Thinning()
    suppress, vote = record_call("EdgeSuppress"), record_call("EdgeVote")
    return Thinning(
        suppress=non_maximum_suppression if suppress is None else _suppression(suppress),
        vote=voted_boxes if vote is None else _voting(vote),
    )


def _suppression(call: RecordCall) -> Callable[..., NDArray[np.int64]]:
    def suppress(
        boxes: FloatArray,
        scores: FloatArray,
        iou: float,
        *,
        groups: NDArray[np.int64] | None = None,
        depths: FloatArray | None = None,
        depth_share: float = 0.0,
    ) -> NDArray[np.int64]:
        order = np.argsort(-scores, kind="stable")
        ranked = np.ascontiguousarray(boxes[order], np.float64).reshape(-1, 4)
        group = None if groups is None else groups[order].astype(np.int64, copy=False)
        depth = None if groups is None or depths is None else depths[order].astype(np.float64, copy=False)
        alive = np.empty(len(order), np.bool_)
        frame = _SuppressionFrame(
            _address(ranked), _address(group), _address(depth), len(order), iou, depth_share, _address(alive)
        )
        if not call(frame):
            return non_maximum_suppression(boxes, scores, iou, groups=groups, depths=depths, depth_share=depth_share)
        kept: NDArray[np.int64] = order[alive]
        return kept

    return suppress


def _voting(call: RecordCall) -> Callable[..., FloatArray32]:
    def vote(
        boxes: FloatArray32, score: FloatArray32, class_id: NDArray[np.int64], keep: NDArray[np.int64], *, iou: float
    ) -> FloatArray32:
        order = np.argsort(-score, kind="stable")
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        columns = (
            np.ascontiguousarray(boxes[order], np.float32).reshape(-1, _COLUMNS),
            score[order].astype(np.float32, copy=False),
            class_id[order].astype(np.int64, copy=False),
            np.ascontiguousarray(rank[keep], np.int64),
        )
        means = np.empty((len(keep), _COLUMNS), np.float32)
        frame = _VotingFrame(
            *(_address(item) for item in columns),
            len(order),
            len(keep),
            iou,
            LEAST_SCORE_SHARE,
            NEAR_DEPTH_SHARE,
            NEAR_ANGLE_RAD,
            _address(means),
        )
        return means if call(frame) else voted_boxes(boxes, score, class_id, keep, iou=iou)

    return vote


def _address(array: NDArray[Any] | None) -> int | None:
    return None if array is None else array.ctypes.data
