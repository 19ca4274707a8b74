"""Measurements as rows of text: one source for the terminal's tables and the report's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from runtime.contracts.measurement import Agreement

LEVELS = ("easy", "moderate", "hard")
METRIC_ORDER = ("3d", "bev", "2d", "aos")
NO_VALUE = "-"


@dataclass(frozen=True, slots=True)
class Table:
    """A heading, column names, rows of text.

    Attributes:
        title: what the table shows, units included.
        columns: names; rows: as many cells each.
        note: a line below the table, empty for none.
        spare_columns: how many of the last columns may be left out where there is no room.
    """

    title: str
    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    note: str = ""
    spare_columns: int = 0


def ap_table(
    ap: dict[str, Any], objects: dict[str, list[int]], *, title: str, interval95: dict[str, Any] | None = None
) -> Table:
    """AP of every class, metric and overlap, with the number of objects that stand behind each class.

    Args:
        ap: class -> metric -> overlap -> ``R40`` / ``R11`` -> [easy, moderate, hard], per cent.
        objects: class -> labelled objects at each difficulty.
        title: heading.
        interval95: the same tree with [low, high] in place of numbers; shown behind R40.
    """
    rows = []
    for name, metrics in ap.items():
        for metric in _ordered(metrics):
            for overlap, points in metrics[metric].items():
                bounds = _branch(interval95, name, metric, overlap, "R40")
                counts = objects.get(name, [0, 0, 0])
                r40 = [_with_interval(value, bounds, level) for level, value in enumerate(points["R40"])]
                r11 = [f"{value:.2f}" for value in points["R11"]]
                r40, r11 = _blank_without_objects(r40, counts), _blank_without_objects(r11, counts)
                rows.append((name, metric, overlap, *r40, *r11))
    columns = (
        "class",
        "metric",
        "IoU",
        *(f"R40 {level}" for level in LEVELS),
        *(f"R11 {level}" for level in LEVELS),
    )
    return Table(title, columns, tuple(rows), note=objects_line(objects), spare_columns=len(LEVELS))


def _blank_without_objects(cells: list[str], counts: list[int]) -> list[str]:
    return [cell if count else NO_VALUE for cell, count in zip(cells, counts, strict=True)]


def objects_line(objects: dict[str, list[int]]) -> str:
    """How many labelled objects stand behind each class."""
    parts = [f"{name} {counts[0]} / {counts[1]} / {counts[2]}" for name, counts in objects.items()]
    return f"Labelled objects (easy / moderate / hard): {', '.join(parts) or 'none'}"


def drop_table(drop: dict[str, Any], interval95: dict[str, Any], *, objects: dict[str, list[int]], title: str) -> Table:
    """Points of AP R40 lost against the reference, each with the 95 % interval of the paired bootstrap."""
    rows = []
    for name, metrics in drop.items():
        for metric in _ordered(metrics):
            for overlap, points in metrics[metric].items():
                bounds = _branch(interval95, name, metric, overlap, "R40")
                cells = [_with_interval(value, bounds, level, sign="+") for level, value in enumerate(points["R40"])]
                cells = _blank_without_objects(cells, objects.get(name, [0, 0, 0]))
                rows.append((name, metric, overlap, *cells))
    columns = ("class", "metric", "IoU", *(f"R40 {level}" for level in LEVELS))
    return Table(title, columns, tuple(rows), note=objects_line(objects))


def agreement_table(agreements: Sequence[tuple[str, Agreement]], *, title: str) -> Table:
    """Matched share and distance of matched centres by distance band, one row a model and band."""
    rows = []
    for name, item in agreements:
        share = f"{100.0 * item.matched_share:.1f} %"
        counts = f"{item.matched_count} of {item.reference_count} and {item.other_count}"
        bands = item.centre_error_m or {"all": None}
        for band, errors in bands.items():
            median, mean = (NO_VALUE, NO_VALUE) if errors is None else (f"{errors[0]:.3f}", f"{errors[1]:.3f}")
            rows.append((name, share, counts, band, median, mean))
            name = share = counts = ""
    columns = ("model", "matched share", "matched", "distance m", "median m", "mean m")
    return Table(title, columns, tuple(rows))


def latency_table(latencies: Sequence[tuple[str, dict[str, float]]], *, title: str, note: str = "") -> Table:
    """Median milliseconds a frame by stage, one row a model."""
    stages = list(dict.fromkeys(stage for _, stages_ms in latencies for stage in stages_ms))
    rows = [
        (name, *(f"{stages_ms[stage]:.2f}" if stage in stages_ms else NO_VALUE for stage in stages))
        for name, stages_ms in latencies
    ]
    return Table(title, ("model", *stages), tuple(rows), note=note)


def _ordered(metrics: dict[str, Any]) -> list[str]:
    return [metric for metric in METRIC_ORDER if metric in metrics]


def _branch(tree: dict[str, Any] | None, *path: str) -> list[Any] | None:
    node: Any = tree
    for key in path:
        if not isinstance(node, dict) or key not in node:
            return None
        node = node[key]
    return node


def _with_interval(value: float, bounds: list[Any] | None, level: int, *, sign: str = "") -> str:
    text = f"{value:{sign}.2f}"
    if bounds is None:
        return text
    low, high = bounds[level]
    return f"{text} [{low:{sign}.1f}, {high:{sign}.1f}]"
