"""A row a quantiser: what is kept of it as JSON, and how the table shows it."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from edge.report.rows import NO_VALUE, Table
from runtime.contracts.measurement import Measurement
from runtime.machine import package_version, processor

SHOWN_AP = (("Car", "0.7"), ("Car", "0.5"), ("Pedestrian", "0.5"), ("Pedestrian", "0.25"))
MODERATE = 1
TOOLS = ("onnxruntime", "onnx", "nncf", "numpy")
ALL_BANDS = "all"
MIB = 1 << 20


@dataclass(frozen=True, slots=True)
class Row:
    """One quantiser's figures; None is what was not measured.

    Attributes:
        title: what the table calls it; settings: beside defaults.
        error: why there is no model, one line.
        wall_secs, cpu_secs: of quantising, calibration and accuracy control included.
        size_bytes: of model.onnx.
        measured_on: name of the source; frames, objects: what it held, objects by class at moderate.
        share: multiply-adds in 8 bits, 0 to 1, in the profile of the optimised graph.
        ap: 3D AP R40 moderate by "class IoU"; drop: [points lost against FP32, low, high], 95 % interval.
        matched_share: of detections at the display score, with FP32's.
        centre_mean_m: mean 3D distance of the matched ones.
        ms, ratio: median of all stages a frame, and its median ratio to FP32's, in one run with all others.
    """

    title: str
    settings: str
    error: str | None = None
    wall_secs: float | None = None
    cpu_secs: float | None = None
    size_bytes: int | None = None
    measured_on: str | None = None
    frames: int = 0
    objects: dict[str, int] = field(default_factory=dict)
    share: float | None = None
    ap: dict[str, float] = field(default_factory=dict)
    drop: dict[str, list[float]] = field(default_factory=dict)
    matched_share: float | None = None
    centre_mean_m: float | None = None
    ms: float | None = None
    ratio: float | None = None

    def measured(self, found: Measurement, *, source: str, share: float) -> Row:
        """The row with a measurement in it."""
        shown = [(name, iou) for name, iou in SHOWN_AP if found.objects.get(name, [0, 0, 0])[MODERATE]]
        drop = {}
        for name, iou in shown:
            if found.drop:
                low, high = found.drop_interval95[name]["3d"][iou]["R40"][MODERATE]
                drop[f"{name} {iou}"] = [found.drop[name]["3d"][iou]["R40"][MODERATE], low, high]
        agreed = found.agreement
        return replace(
            self,
            measured_on=source,
            frames=found.frames,
            objects={name: counts[MODERATE] for name, counts in found.objects.items()},
            share=share,
            ap={f"{name} {iou}": found.ap[name]["3d"][iou]["R40"][MODERATE] for name, iou in shown},
            drop=drop,
            matched_share=None if agreed is None else agreed.matched_share,
            centre_mean_m=None if agreed is None else agreed.centre_error_m.get(ALL_BANDS, (0.0, 0.0))[1],
        )


def comparison_table(rows: Sequence[Row], *, calibrated_on: str) -> Table:
    """The rows as text; the first is FP32."""
    reference = rows[0]
    columns = (
        "quantiser",
        *(f"{name} {iou}" for name, iou in SHOWN_AP),
        *("matched %", "shift m", "ms", "of FP32", "8-bit %", "MiB", "quantised in s", "processor s"),
    )
    failed = any(row.error is not None for row in rows)
    objects = ", ".join(f"{count} {name}" for name, count in reference.objects.items() if count)
    note = (
        f"3D AP R40 moderate: FP32's, then points lost against it with the 95 % interval over frames. Calibrated on "
        f"{calibrated_on}; measured on {reference.frames} frames of {reference.measured_on} ({objects or 'no labels'})."
    )
    cells = [(*_cells(row, row is reference), *([row.error or ""] if failed else [])) for row in rows]
    return Table("Quantisers", (*columns, "why not") if failed else columns, tuple(cells), note=note)


def machine_line() -> str:
    """Processor and versions, one line."""
    cpu = processor()
    versions = ", ".join(f"{name} {package_version(name) or 'missing'}" for name in TOOLS)
    flags = " ".join(cpu.flags or ())
    load = f"{os.getloadavg()[0]:.1f}"
    return f"{cpu.model}, {cpu.cores} cores ({flags}), load {load}; Python {platform.python_version()}, {versions}"


def _cells(row: Row, is_reference: bool) -> tuple[str, ...]:
    points = []
    for name, iou in SHOWN_AP:
        key = f"{name} {iou}"
        lost = row.drop.get(key)
        if is_reference:
            points.append(f"{row.ap[key]:.1f}" if key in row.ap else NO_VALUE)
        else:
            points.append(NO_VALUE if lost is None else f"{lost[0]:+.1f} [{lost[1]:+.1f}, {lost[2]:+.1f}]")
    return (
        row.title,
        *points,
        _number(row.matched_share, ".1f", 100.0),
        _number(row.centre_mean_m, ".3f"),
        _number(row.ms, ".0f"),
        _number(row.ratio, ".2f"),
        _number(row.share, ".1f", 100.0),
        _number(row.size_bytes, ".1f", 1 / MIB),
        _number(row.wall_secs, ".0f"),
        _number(row.cpu_secs, ".0f"),
    )


def _number(value: float | None, form: str, factor: float = 1.0) -> str:
    return NO_VALUE if value is None else f"{value * factor:{form}}"
