"""Records of what a model did: the currency between measuring, budget search and report."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

NEAR_M: Final = 30.0
NEAR_BAND: Final = "0-30"
"""Distance band below `NEAR_M`: what a vehicle brakes for, and what a budget of shift counts."""


@dataclass(frozen=True, slots=True)
class Agreement:
    """How far two models' detections agree on the same frames, at the display threshold.

    Same class, one to one, greedy by score, 2D IoU at least 0.5.

    Attributes:
        matched_share: 2 x matched / (n_reference + n_other), 1.0 when neither found anything.
        reference_count, other_count, matched_count: detections.
        centre_error_m: distance band (``all``, `NEAR_BAND`, ``0-15``, ...) to (median, mean) 3D distance of matched
            pairs in metres.
    """

    matched_share: float
    reference_count: int
    other_count: int
    matched_count: int
    centre_error_m: dict[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Measurement:
    """One model on one source.

    Attributes:
        path: model directory.
        ap: class -> metric (``3d``, ``bev``, ``2d``, ``aos``) -> IoU -> ``R40`` / ``R11`` -> [easy, moderate, hard] in
            per cent; empty where the source has no labels.
        frames: frame count.
        objects: class -> [easy, moderate, hard] count of labelled objects.
        latency_ms: stage -> median milliseconds a frame.
        agreement: with the reference model, None for the reference itself.
        ap_interval95: the same tree as ``ap`` with [low, high] in place of each number: bootstrap over frames.
        drop: AP points lost against the reference, the same tree; empty for the reference itself.
        drop_interval95: its intervals: the same frames drawn for both models.
    """

    path: str
    ap: dict[str, dict[str, dict[str, dict[str, list[float]]]]]
    frames: int
    objects: dict[str, list[int]] = field(default_factory=dict)
    latency_ms: dict[str, float] = field(default_factory=dict)
    agreement: Agreement | None = None
    ap_interval95: dict[str, Any] = field(default_factory=dict)
    drop: dict[str, Any] = field(default_factory=dict)
    drop_interval95: dict[str, Any] = field(default_factory=dict)
