"""What INT8 costs over the number of calibration frames: a record and a plot, one line a way of choosing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from edge.report.files import write_json
from runtime.model_folder import CURVE_PLOT, CURVE_RECORD

_SIZE_INCHES, _DOTS_PER_INCH = (8.0, 3.6), 110


@dataclass(frozen=True, slots=True)
class CurvePoint:
    """One INT8 model.

    Attributes:
        choice: how its calibration frames were chosen.
        frames: how many.
        coverage: score of the choice, 0 to 1.
        matched_share: agreement of its detections with the float model's, 0 to 1.
        centre_error_m: median 3D distance of matched detections; None where none matched.
        drop_points: worst loss of moderate 3D AP; None without labels.
    """

    choice: str
    frames: int
    coverage: float
    matched_share: float
    centre_error_m: float | None
    drop_points: float | None


def write_curve(
    folder: Path,
    points: Sequence[CurvePoint],
    *,
    calibration: str,
    range_method: str,
    measured_on: str,
    measured_frames: int,
) -> bool:
    """Writes ``curve.json``, and ``curve.png`` where matplotlib is there.

    Args:
        folder: Model directory.
        points: In any order.
        calibration: Name of the source of the frames.
        range_method: Where all ranges come from.
        measured_on: Name of the source that measured.
        measured_frames: How many frames that has.

    Returns:
        Whether the picture was drawn.

    Raises:
        OutputError: The folder cannot be written.
    """
    record = {
        "schema": 1,
        "calibration": calibration,
        "range_method": range_method,
        "measured_on": measured_on,
        "measured_frames": measured_frames,
        "points": [asdict(point) for point in points],
    }
    write_json(folder / CURVE_RECORD, record)
    try:
        _draw(folder / CURVE_PLOT, points)
    except ImportError:
        return False
    return True


def _draw(path: Path, points: Sequence[CurvePoint]) -> None:
    import matplotlib

    matplotlib.use("agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=_SIZE_INCHES, layout="constrained")
    labelled = any(point.drop_points is not None for point in points)
    agreement, loss = figure.subplots(1, 2)
    for choice in dict.fromkeys(point.choice for point in points):
        line = sorted((point for point in points if point.choice == choice), key=lambda point: point.frames)
        frames = [point.frames for point in line]
        agreement.plot(frames, [100 * point.matched_share for point in line], "o-", lw=1, label=choice)
        second = [point.drop_points if labelled else point.centre_error_m for point in line]
        loss.plot(frames, [float("nan") if value is None else value for value in second], "o-", lw=1, label=choice)
    agreement.set_ylabel("detections that agree with float32, per cent")
    loss.set_ylabel("points of 3D AP lost" if labelled else "median centre error, m")
    for axes in (agreement, loss):
        axes.set_xscale("log", base=2)
        counts = sorted({point.frames for point in points})
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.set_xlabel("calibration frames")
        if points:
            axes.legend(fontsize=8)
    figure.savefig(path, dpi=_DOTS_PER_INCH, metadata={"Software": None})
