"""Single detections that a second model lost, found anew, or moved; and the pictures of the frames that differ most."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.evaluation.agreement import pair_up
from edge.evaluation.run import ModelRun
from edge.report.differences import MOVED_M, compare_frame, draw_differences, most_different
from edge.report.files import write_picture
from edge.report.rows import NO_VALUE, Table
from runtime.contracts.objects import Detections3D
from runtime.sources.base import FrameSequence

PICTURES_FOLDER = "pictures"
LOST, NEW, MOVED = "lost", "new", "moved"
ROWS_SHOWN = 30


@dataclass(frozen=True, slots=True)
class Change:
    """A detection at the display threshold that the two models do not share.

    Attributes:
        frame_id, name: frame and class.
        state: ``lost`` (only the reference has it), ``new`` (only the other), ``moved``.
        score: of the model that has it; of the reference where both do.
        distance_m: from the camera, likewise.
        shift_m: between the two centres; None where one has none.
        picture: path relative to the report; empty beyond the frames that have a picture.
    """

    frame_id: str
    name: str
    state: str
    score: float
    distance_m: float
    shift_m: float | None = None
    picture: str = ""


def changes_of(reference: ModelRun, other: ModelRun, pictures: dict[str, str] | None = None) -> list[Change]:
    """All changed detections: lost, new, moved; within each the surest first, moved ones by how far.

    Args:
        reference, other: runs over the same frames.
        pictures: frame id to the picture's path.
    """
    found = []
    for frame_id, left, right in zip(reference.frame_ids, reference.detections, other.detections, strict=True):
        left, right = left.above(reference.score_display), right.above(other.score_display)
        pairs = pair_up(left, right)
        shift_m = np.linalg.norm(left.center_in_camera[pairs.first] - right.center_in_camera[pairs.second], axis=1)
        picture = (pictures or {}).get(frame_id, "")
        found += [_change(left, row, frame_id, LOST, None, picture) for row in pairs.only_first]
        found += [_change(right, row, frame_id, NEW, None, picture) for row in pairs.only_second]
        found += [
            _change(left, row, frame_id, MOVED, float(shift), picture)
            for row, shift in zip(pairs.first, shift_m, strict=True)
            if shift > MOVED_M
        ]
    order = (LOST, NEW, MOVED)
    return sorted(found, key=lambda item: (order.index(item.state), -(item.shift_m or 0.0), -item.score))


def _change(boxes: Detections3D, row: int, frame_id: str, state: str, shift_m: float | None, picture: str) -> Change:
    return Change(
        frame_id,
        boxes.class_names[boxes.class_id[row]],
        state,
        float(boxes.score[row]),
        float(np.linalg.norm(boxes.center_in_camera[row])),
        shift_m,
        picture,
    )


def changes_table(changes: Sequence[Change]) -> Table:
    """The changed detections, `ROWS_SHOWN` shared fairly among lost, new and moved."""
    each = ROWS_SHOWN // 3
    shown = [item for state in (LOST, NEW, MOVED) for item in [c for c in changes if c.state == state][:each]]
    rows = tuple(
        (
            item.state,
            item.frame_id,
            item.name,
            f"{item.score:.2f}",
            f"{item.distance_m:.1f}",
            NO_VALUE if item.shift_m is None else f"{item.shift_m:.2f}",
            f"[picture]({item.picture})" if item.picture else NO_VALUE,
        )
        for item in shown
    )
    counts = ", ".join(f"{sum(item.state == state for item in changes)} {state}" for state in (LOST, NEW, MOVED))
    note = (
        f"{counts}; at most {each} of each are shown, report.json has all. Moved: by more than {MOVED_M} m. "
        "Pictures exist for the frames that differ most."
    )
    columns = ("state", "frame", "class", "score", "distance m", "shift m", "picture")
    return Table("Detections lost, new and moved", columns, rows, note=note)


def write_pictures(
    out: Path,
    frames: FrameSequence,
    *,
    reference: ModelRun,
    other: ModelRun,
    names: tuple[str, str],
    limit: int,
    subfolder: str = "",
    folder: str = PICTURES_FOLDER,
) -> list[tuple[str, str, str]]:
    """Draw the frames that differ most, image and bird's-eye view side by side.

    Args:
        out: folder of the report.
        frames: what both models saw.
        reference, other: their runs.
        names: of the two.
        limit: how many frames at most; frames without a difference get no picture.
        subfolder: below ``folder``; empty for none.
        folder: part of the path below ``out``.

    Returns:
        Frame id, caption, and path relative to ``out`` of each.

    Raises:
        OutputError: the folder cannot be written.
    """
    differences = [
        compare_frame(left.above(reference.score_display), right.above(other.score_display))
        for left, right in zip(reference.detections, other.detections, strict=True)
    ]
    written = []
    for index in most_different(differences, limit):
        item, frame_id = differences[index], reference.frame_ids[index]
        if not item.count:
            continue
        stem = re.sub(r"[^\w.-]+", "_", frame_id).strip("_")
        place = Path(folder) / subfolder / f"{stem}.jpg"
        write_picture(out / place, draw_differences(frames[index], item, names))
        caption = f"{names[1]}, frame {frame_id}: {item.lost} lost, {item.new} new, {item.moved} moved"
        written.append((frame_id, caption, place.as_posix()))
    return written
