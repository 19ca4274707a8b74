"""``edge quantize --curve``: what INT8 costs over the number of calibration frames, and over how they are chosen."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from edge.cli.quantize_report import REPORT_FRAMES
from edge.cli.source_names import public_name
from edge.cli.stages import say, stage_progress, warn

if TYPE_CHECKING:
    from calib.ranges import Progress
    from edge.report.curve import CurvePoint
    from quantize.prepare import Prepared
    from quantize.range_search import RangeSearch
    from runtime.contracts.measurement import Measurement

EVEN = "spread"
"""The choice that every curve is compared with."""


def curve_counts(text: str | None) -> tuple[int, ...]:
    """Numbers of frames from ``1,4,16,64``; empty where no curve was asked for.

    Raises:
        QuantizeError: these are no rising numbers.
    """
    from quantize.errors import QuantizeError

    if text is None:
        return ()
    parts = text.split(",")
    counts = tuple(int(part) for part in parts if part.strip().isdecimal())
    if len(counts) != len(parts) or min(counts) < 1 or any(few >= more for few, more in pairwise(counts)):
        raise QuantizeError(f"--curve: found {text!r}; expected rising numbers of frames; for example 1,4,16,64")
    return counts


def write_curve_of(
    prepared: Prepared,
    folder: Path,
    counts: Sequence[int],
    *,
    calibration: str,
    choice: str,
    validation: str | None,
    settled: RangeSearch,
    use_cache: bool,
    allow_other_rig: bool,
) -> None:
    """Measures models of growing calibration sets and writes curve.json and curve.png into a model directory.

    Each way of choosing runs the float model once over its largest set: what the first few frames showed is noted on
    the way. Equalised channels stay those of the written model; biases are corrected by each set's own frames.

    Args:
        prepared: The float model, equalised.
        folder: The written INT8 model directory.
        counts: Rising numbers of frames.
        calibration: URI of the frames that calibrate.
        choice: Way of choosing that is compared with even spread.
        validation: URI of the frames that measure; None for the bundled drive.
        settled: Ranges of the written model. The curve's come from the method that they do: a search for each set would
            take minutes.
        use_cache: Look for, and keep, features of frames in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
    """
    import tempfile

    from calib.choice import Choice, choose_from
    from calib.coverage import score
    from calib.frames import say_nothing
    from edge.cli.calibration_overlap import warn_of_overlap
    from edge.evaluation.measure import assess, measurement
    from edge.evaluation.run import run_model
    from edge.report.curve import write_curve
    from edge.samples import measuring_source
    from quantize.adjustments import adjust, build_adjusted
    from quantize.prefixes import looked_at, observe_first
    from quantize.write import write_directory
    from runtime.sources.factory import open_sequence

    method = settled.method
    if settled.trials:
        say(f"curve: ranges by {method} alone, not searched as those of {folder.name} are")
    uri = validation or f"{measuring_source()}?limit={REPORT_FRAMES}"
    points: list[CurvePoint] = []
    with (
        open_sequence(calibration) as frames,
        open_sequence(uri) as source,
        tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as made,
        stage_progress() as progress,
    ):
        pool = looked_at(
            prepared, frames, max(counts), use_cache=use_cache, allow_other_rig=allow_other_rig, progress=progress
        )
        reference = assess(run_model(prepared.source.path, source, allow_other_rig=allow_other_rig, warn=warn))
        before = measurement(reference)
        for way in dict.fromkeys((choice, EVEN)):
            whole = choose_from(pool, frames, max(counts), name=public_name(calibration), method=way)
            warn_of_overlap(
                whole.chosen,
                source,
                name=public_name(uri),
                use_cache=use_cache,
                tell=lambda line, way=way: warn(f"{way}: {line}"),
            )
            seen = observe_first(
                prepared, whole, counts, allow_other_rig=allow_other_rig, progress=_named(progress, way)
            )
            for done, (count, calibrated) in enumerate(sorted(seen.items())):
                ranges = calibrated.observation.ranges(method)
                few = whole.chosen.first(count)
                adjusted = adjust(
                    prepared,
                    calibrated,
                    ranges,
                    Choice(few, whole.source),
                    use_cache=False,
                    allow_other_rig=allow_other_rig,
                )
                graph = build_adjusted(prepared, calibrated, ranges, adjusted)
                written = write_directory(prepared, graph, calibrated, Path(made) / f"{way}-{count}", method=method)
                run = run_model(written.path, source, allow_other_rig=allow_other_rig, warn=say_nothing)
                coverage = score(pool.between, [pool.frames.index(frame) for frame in few.frames])
                points.append(_point(way, count, coverage, before, measurement(assess(run), reference)))
                progress(f"measuring the curve, {way}", done + 1, len(seen))
    drawn = write_curve(
        folder,
        points,
        calibration=public_name(calibration),
        range_method=method,
        measured_on=public_name(uri),
        measured_frames=len(reference.run.frame_ids),
    )
    for point in points:
        lost = "" if point.drop_points is None else f", {point.drop_points:+.2f} points"
        say(f"curve: {point.frames:4d} frames by {point.choice}: {100 * point.matched_share:.2f} % agree{lost}")
    if not drawn:
        warn("no picture of the curve: matplotlib is missing; pip install '.[report]'")


def _named(progress: Progress, way: str) -> Progress:
    return lambda stage, done, total: progress(f"{stage}, {way}", done, total)


def _point(way: str, count: int, coverage: float, before: Measurement, after: Measurement) -> CurvePoint:
    from edge.report.curve import CurvePoint
    from quantize.budget_kinds import ap_drop_points, disagreement_points
    from quantize.errors import QuantizeError

    try:
        drop_points = ap_drop_points(before, after)
    except QuantizeError:
        drop_points = None  # frames without labels have agreement alone
    centre = None if after.agreement is None else after.agreement.centre_error_m.get("all")
    return CurvePoint(
        choice=way,
        frames=count,
        coverage=coverage,
        matched_share=1.0 - disagreement_points(after) / 100.0,
        centre_error_m=None if centre is None else centre[0],
        drop_points=drop_points,
    )
