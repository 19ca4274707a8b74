"""The report of a quantised model: what was done, what it cost, and where INT8 disturbs the network."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from edge.report.document import report_text
from edge.report.evidence import Evidence
from edge.report.files import write_json, write_text
from edge.report.markdown import markdown_table
from edge.report.parity import ParityRecord, parity_table
from edge.report.records import report_record
from edge.report.repeat import RepeatRecord, repeat_text
from edge.report.rows import NO_VALUE, Table
from runtime.contracts.measurement import Measurement
from runtime.model_folder import REPORT_RECORD, REPORT_TEXT
from runtime.peak_memory import PeakMemory

LAYERS_SHOWN = 15
ABOUT_MEMORY = (
    "Memory: the most that a process of its own held while it loaded and ran the model; in brackets what was added to "
    "Python and its packages."
)


@dataclass(frozen=True, slots=True)
class LayerRow:
    """A layer's noise: ``snr_db`` at its output, with all noise from before."""

    node: str
    operator: str
    snr_db: float
    multiply_adds: int


@dataclass(frozen=True, slots=True)
class BudgetRow:
    """A model that the budget search tried: layers in float, what was lost, milliseconds of inference, adjustments."""

    given_back: tuple[str, ...]
    lost: float
    inference_ms: float | None
    holds: bool
    way: str = ""


@dataclass(frozen=True, slots=True)
class QuantisationRecord:
    """What `edge quantize` did.

    Attributes:
        facts: name -> value, for the top of the report.
        calibration_frames: (frame id, start of the pixels' SHA-256).
        layers: noise of every layer.
        kept_float: (node, why) of operators that the recipe would have taken.
        latency: one record a model, float first, as `runtime.turns` gives them; empty where nothing was timed.
        size_bytes: of both ONNX files, float first.
        budget: path of the search; empty without one; budget_unit: of what was lost.
        int8_share: of the multiply-adds in the graph.
        int8_share_run: of the multiply-adds that ONNX Runtime ran; None where nothing was timed.
        memory: of a process that runs the float model, and one that runs the INT8 one; None where it was not told.
        parity: of what both models see; repeat: how to do it again; None where it was not looked at.
    """

    facts: dict[str, str]
    calibration_frames: tuple[tuple[str, str], ...]
    layers: tuple[LayerRow, ...]
    kept_float: tuple[tuple[str, str], ...]
    size_bytes: tuple[int, int]
    int8_share: float
    int8_share_run: float | None = None
    latency: tuple[dict[str, Any], ...] = ()
    budget: tuple[BudgetRow, ...] = field(default=())
    budget_unit: str = ""
    memory: tuple[PeakMemory | None, ...] = ()
    parity: ParityRecord | None = None
    repeat: RepeatRecord | None = None


def write_quantisation_report(
    folder: Path,
    record: QuantisationRecord,
    measurements: Sequence[Measurement],
    *,
    source: str,
    evidence: Evidence | None = None,
) -> None:
    """Write ``report.md`` and ``report.json`` of a quantised model directory.

    Args:
        folder: the directory.
        record: what was done.
        measurements: float first, then INT8; empty where nothing was measured.
        source: name of the measured frames.
        evidence: pictures and tables of single detections, distances, ranges.

    Raises:
        OutputError: the folder cannot be written.
    """
    shown = evidence or Evidence()
    text = report_text(measurements, title="INT8 report", source=source, facts=record.facts, pictures=shown.pictures)
    text += "".join(markdown_table(table) for table in shown.tables)
    text += "".join(markdown_table(table) for table in quantisation_tables(record))
    text += "" if record.repeat is None else repeat_text(record.repeat)
    content = report_record(measurements, source=source, facts=record.facts)
    content["quantisation"] = _as_json(record)
    content["evidence"] = shown.record or {}
    content["parity"] = None if record.parity is None else record.parity.as_json()
    content["repeat"] = None if record.repeat is None else record.repeat.as_json()
    write_json(folder / REPORT_RECORD, content)
    write_text(folder / REPORT_TEXT, text)


def quantisation_tables(record: QuantisationRecord) -> list[Table]:
    """Parity, cost, budget and noise as tables; those without rows are left out."""
    checked = [] if record.parity is None else [parity_table(record.parity)]
    tables = [*checked, cost_table(record), budget_table(record), noise_table(record), float_table(record)]
    return [table for table in tables if table.rows]


def cost_table(record: QuantisationRecord) -> Table:
    """Size, latency and memory before and after."""
    rows = []
    for position, name in enumerate(("float32", "INT8")):
        timed = record.latency[position] if record.latency else None
        rows.append(
            (
                name,
                f"{record.size_bytes[position] / 1e6:.1f}",
                NO_VALUE if timed is None else f"{timed['stages']['inference']['median']:.1f}",
                NO_VALUE if timed is None else f"{timed['stages']['total']['median']:.1f}",
                NO_VALUE if timed is None else f"{timed['ratio']:.2f}",
                _peak(record, position),
                f"{100 * record.int8_share:.1f} %" if position else "0.0 %",
            )
        )
    columns = ("model", "MB", "inference ms", "total ms", "ratio", "peak memory MiB", "INT8 multiply-adds")
    note = (
        ""
        if record.int8_share_run is None
        else (f"In ONNX Runtime's own profile {100 * record.int8_share_run:.1f} % of the multiply-adds ran in 8 bits.")
    )
    if any(item is not None for item in record.memory):
        note += f"{' ' if note else ''}{ABOUT_MEMORY}"
    return Table("Cost on this machine", columns, tuple(rows), note=note)


def _peak(record: QuantisationRecord, position: int) -> str:
    """Peak and, in brackets, what of it is the model's."""
    found = record.memory[position] if position < len(record.memory) else None
    return NO_VALUE if found is None else f"{found.peak_mib:.0f} ({found.peak_mib - found.before_mib:.0f})"


def budget_table(record: QuantisationRecord) -> Table:
    """What the search tried."""
    rows = tuple(
        (
            str(len(item.given_back)),
            f"{item.lost:+.2f}",
            NO_VALUE if item.inference_ms is None else f"{item.inference_ms:.1f}",
            "holds" if item.holds else "over",
            ", ".join(item.given_back[-3:]) or NO_VALUE,
            item.way or NO_VALUE,
        )
        for item in record.budget
    )
    return Table(
        "Accuracy budget: what was tried",
        ("layers in float", record.budget_unit, "inference ms", "budget", "last given", "adjustments"),
        rows,
    )


def noise_table(record: QuantisationRecord) -> Table:
    """The layers that drifted most from their float twins."""
    worst = sorted(record.layers, key=lambda item: item.snr_db)[:LAYERS_SHOWN]
    rows = tuple((item.node, item.operator, f"{item.snr_db:.1f}", f"{item.multiply_adds / 1e6:.0f}") for item in worst)
    return Table(
        f"Signal-to-noise of the {len(rows)} noisiest of {len(record.layers)} layers",
        ("layer", "operator", "dB", "M multiply-adds"),
        rows,
        note="At the layer's output, noise of all layers before it included; report.json has every layer.",
    )


def float_table(record: QuantisationRecord) -> Table:
    """Operators that stayed float, and why."""
    return Table("What stayed float", ("node", "why"), record.kept_float)


def _as_json(record: QuantisationRecord) -> dict[str, Any]:
    return {
        "calibration_frames": [{"frame_id": name, "pixels": pixels} for name, pixels in record.calibration_frames],
        "layers": [
            {"node": i.node, "operator": i.operator, "snr_db": i.snr_db, "multiply_adds": i.multiply_adds}
            for i in record.layers
        ],
        "kept_float": [{"node": node, "why": why} for node, why in record.kept_float],
        "latency": list(record.latency),
        "memory": [None if item is None else asdict(item) for item in record.memory],
        "size_bytes": {"float32": record.size_bytes[0], "int8": record.size_bytes[1]},
        "int8_share_of_multiply_adds": {"graph": record.int8_share, "run": record.int8_share_run},
        "budget_unit": record.budget_unit,
        "budget": [
            {
                "given_back": list(item.given_back),
                "lost": item.lost,
                "inference_ms": item.inference_ms,
                "holds": item.holds,
                "adjustments": item.way,
            }
            for item in record.budget
        ],
    }
