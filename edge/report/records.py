"""Measurements as plain records for JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from edge.evaluation.depth_error import DepthError
from runtime.contracts.measurement import Agreement, Measurement

REPORT_SCHEMA = 1


def accuracy_record(measurements: Sequence[Measurement]) -> dict[str, Any]:
    """What ``edge accuracy --json`` writes.

    ``{"models": [{"path", "ap", "frames", "objects"}], "against_first": [{"drop", "interval95",
    "matched_share", "centre_error_m"}]}``; ``ap``, ``drop`` and ``interval95`` are empty where the source has
    no labels; ``centre_error_m`` is band -> ``median``, ``mean``.

    Args:
        measurements: the first is the reference; the others hold their agreement with it.
    """
    return {
        "models": [
            {"path": item.path, "ap": item.ap, "frames": item.frames, "objects": item.objects} for item in measurements
        ],
        "against_first": [
            {
                "drop": item.drop,
                "interval95": item.drop_interval95,
                "matched_share": item.agreement.matched_share,
                "centre_error_m": _centre_error(item.agreement),
            }
            for item in measurements[1:]
            if item.agreement is not None
        ],
    }


def report_record(
    measurements: Sequence[Measurement],
    *,
    source: str,
    depth_errors: Sequence[dict[str, dict[str, DepthError]]] = (),
    facts: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """What report.json holds: `accuracy_record` with intervals, latencies, counts and where the figures come from.

    Args:
        measurements: the first is the reference.
        source: URI of the frames.
        depth_errors: of each model, class -> band -> error; may be left out.
        facts: more to keep under ``facts`` (recipe, calibration, machine).
    """
    record = accuracy_record(measurements)
    for index, item in enumerate(measurements):
        record["models"][index]["interval95"] = item.ap_interval95
        record["models"][index]["latency_ms"] = item.latency_ms
        if index < len(depth_errors):
            record["models"][index]["depth_error"] = {
                name: {band: asdict(error) for band, error in bands.items()}
                for name, bands in depth_errors[index].items()
            }
    others = [item.agreement for item in measurements[1:] if item.agreement is not None]
    for branch, agreed in zip(record["against_first"], others, strict=True):
        branch["detections"] = {
            "reference": agreed.reference_count,
            "other": agreed.other_count,
            "matched": agreed.matched_count,
        }
    return {"schema_version": REPORT_SCHEMA, "source": source, **record, "facts": facts or {}}


def _centre_error(agreement: Agreement) -> dict[str, dict[str, float]]:
    return {band: {"median": median, "mean": mean} for band, (median, mean) in agreement.centre_error_m.items()}
