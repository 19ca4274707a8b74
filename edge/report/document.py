"""report.md: what was measured, on what, how sure it is."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge.evaluation.depth_error import DepthError
from edge.report.markdown import markdown_table
from edge.report.rows import Table, agreement_table, ap_table, drop_table, latency_table
from runtime.contracts.measurement import Measurement

NOT_MEASURED = "Nothing was measured: there are no figures of accuracy here."
NO_LABELS = (
    "The source has no labels: there is no AP here, only how far the models agree with each other. "
    "Agreement with a reference says nothing about how right the reference is."
)
ABOUT_INTERVALS = (
    "Square brackets hold 95 % intervals from 1,000 draws of the frames with replacement, the same draws for all "
    "models. Frames of one drive resemble each other: with few drives the truth is less certain than the intervals say."
)
ABOUT_LATENCY = "Medians while measuring, on whatever else the machine did; `edge bench` measures properly."


def model_names(measurements: Sequence[Measurement]) -> list[str]:
    """The shortest ends of the paths that tell the models apart."""
    parts = [tuple(part for part in Path(item.path).parts if part != "/") or (item.path,) for item in measurements]
    for depth in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(item[-depth:]) for item in parts]
        if len(set(names)) == len(names):
            return names
    return [f"{item[-1]} ({number})" for number, item in enumerate(parts, start=1)]


def report_tables(
    measurements: Sequence[Measurement], *, depth_errors: Sequence[dict[str, dict[str, DepthError]]] = ()
) -> list[Table]:
    """All tables of a comparison: AP of each model, drop, agreement, depth error, latency."""
    names = model_names(measurements)
    tables = []
    for name, item in zip(names, measurements, strict=True):
        if item.ap:
            title = f"{name}: KITTI AP in per cent, {item.frames} frames"
            tables.append(ap_table(item.ap, item.objects, title=title, interval95=item.ap_interval95))
    others = list(zip(names, measurements, strict=True))[1:]
    for name, item in others:
        if item.drop:
            title = f"{name} against {names[0]}: AP points lost (positive: worse than the reference)"
            tables.append(drop_table(item.drop, item.drop_interval95, objects=item.objects, title=title))
    agreements = [(name, item.agreement) for name, item in others if item.agreement is not None]
    tables.append(agreement_table(agreements, title=f"Agreement with {names[0] if names else 'the reference'}"))
    for name, errors in zip(names, depth_errors, strict=False):
        tables.append(
            depth_table(
                errors, title=f"{name}: depth and centre error of found objects against the labels, by distance"
            )
        )
    latencies = [(name, item.latency_ms) for name, item in zip(names, measurements, strict=True) if item.latency_ms]
    tables.append(latency_table(latencies, title="Latency in ms a frame", note=ABOUT_LATENCY))
    return [table for table in tables if table.rows]


def depth_table(errors: dict[str, dict[str, DepthError]], *, title: str) -> Table:
    """Depth error by class and distance band of the label."""
    rows = tuple(
        (
            name,
            band,
            str(item.found),
            f"{item.median_abs_m:.2f}",
            f"{100 * item.median_share:.1f} %",
            f"{item.bias_m:+.2f}",
            f"{item.median_centre_m:.2f}",
            f"{item.mean_centre_m:.2f}",
        )
        for name, bands in errors.items()
        for band, item in bands.items()
    )
    columns = ("class", "distance m", "found", "median m", "median share", "bias m", "centre median m", "centre mean m")
    return Table(title, columns, rows)


def report_text(
    measurements: Sequence[Measurement],
    *,
    title: str,
    source: str,
    facts: dict[str, str] | None = None,
    depth_errors: Sequence[dict[str, dict[str, DepthError]]] = (),
    pictures: Sequence[tuple[str, str]] = (),
) -> str:
    """The report as Markdown.

    Args:
        measurements: the first is the reference.
        title: heading.
        source: URI of the frames.
        facts: lines of ``name: value`` at the top.
        depth_errors: of each model.
        pictures: caption and path relative to the report.
    """
    lines = [f"# {title}", "", f"- source: `{source}`"]
    if measurements:
        lines.append(f"- frames: {measurements[0].frames}")
    lines += [f"- {name}: {value}" for name, value in (facts or {}).items()]
    labelled = any(item.ap for item in measurements)
    about = (ABOUT_INTERVALS if labelled else NO_LABELS) if measurements else NOT_MEASURED
    lines += ["", about, ""]
    text = "\n".join(lines) + "\n"
    text += "".join(markdown_table(table) for table in report_tables(measurements, depth_errors=depth_errors))
    if pictures:
        text += "### Where they differ most\n\n"
        text += "Grey: found by both. Yellow: moved. Red: only the reference. Blue: only the other.\n\n"
        text += "".join(f"{caption}\n\n![{caption}]({path})\n\n" for caption, path in pictures)
    return text
