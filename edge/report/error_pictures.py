"""Pictures of what a model misses and what it invents: the place in the left view, and the scene from above.

Labels are thin white wires, detections coloured boxes with score and distance; a frame marks the case itself, red for
an object that was missed, orange for an invention.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.evaluation.outcomes import Invention, Outcomes, Target
from edge.evaluation.run import ModelRun
from edge.report.files import write_json, write_picture
from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Detections3D, Objects3D
from runtime.sinks.bird_eye import BirdEyeView
from runtime.sinks.boxes_in_image import draw_boxes, draw_label_boxes
from runtime.sinks.palette import BACKGROUND, TEXT, Colour
from runtime.sinks.shapes import draw_outline
from runtime.sinks.text import draw_text
from runtime.sources.base import FrameSequence

VIEW_WH = (900, 520)
BIRD_EYE_WIDTH_PX = 380
CAPTION_PX = 34
TEXT_PX = 18
MIN_CUT_PX = 260
"""Least width of what is cut from the image, so that a small object keeps its surroundings."""
ROOM = 3.0
"""Width and height of the cut over those of the object."""
MISSED: Colour = (70, 70, 240)
INVENTED: Colour = (40, 150, 250)
MISSED_NAME, INVENTED_NAME, CASES_FILE = "missed", "invented", "cases.json"

Image = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class Case:
    """A picture's subject: what it is, its box in the left image (4,), and its colour."""

    caption: str
    box: NDArray[np.float64]
    colour: Colour


def write_error_pictures(
    folder: Path, frames: FrameSequence, run: ModelRun, outcomes: Outcomes, labelled: Sequence[int], *, limit: int
) -> list[dict[str, Any]]:
    """Draw the tallest missed objects and the surest inventions, and list them in ``cases.json``.

    Args:
        folder: where to.
        frames: what the model saw.
        run: what it found.
        outcomes: of ``run`` on its labelled frames.
        labelled: index among ``frames`` of each of those.
        limit: pictures of each kind at most.

    Returns:
        One record a picture.

    Raises:
        OutputError: the folder cannot be written.
    """
    cases: list[dict[str, Any]] = []
    worst: list[tuple[str, Sequence[Target | Invention]]] = [
        (MISSED_NAME, outcomes.missed[:limit]),
        (INVENTED_NAME, outcomes.inventions[:limit]),
    ]
    for kind, items in worst:
        for number, item in enumerate(items, start=1):
            index = labelled[item.frame]
            labels = run.labels[index]
            assert labels is not None  # outcomes are of labelled frames
            found = run.detections[index].above(run.score_display)
            frame_id = run.frame_ids[index]
            picture = draw_case(frames[index], case_of(item, labels, run.detections[index]), found, labels)
            words = f"{kind}-{number:02d}-{item.name}-{item.distance_m:.0f}m-{item.state}-{frame_id}"
            name = re.sub(r"[^\w.-]+", "_", words) + ".jpg"
            write_picture(folder / name, picture)
            cases.append({"picture": name, "kind": kind, "frame_id": frame_id, **asdict(item)})
    write_json(folder / CASES_FILE, cases)
    return cases


def case_of(item: Target | Invention, labels: Objects3D, detections: Detections3D) -> Case:
    """Caption, place and colour of a missed object or an invention."""
    if isinstance(item, Target):
        score = "" if item.score is None else f", found at score {item.score:.2f}"
        caption = f"missed {item.name} at {item.distance_m:.0f} m, {item.height_px:.0f} px high, occlusion "
        caption += f"{item.occlusion}, truncation {item.truncation:.2f}: {item.state}{score}"
        return Case(caption, labels.box_in_left_image[item.row], MISSED)
    caption = f"invented {item.name} at {item.distance_m:.0f} m, score {item.score:.2f}: {item.state}"
    return Case(caption, detections.box_in_left_image[item.row], INVENTED)


def draw_case(frame: StereoFrame, case: Case, found: Detections3D, labels: Objects3D) -> Image:
    """The picture of one case, (H, W, 3) uint8 BGR."""
    left, top, width, height = cut_around(case.box, frame.size_wh)
    scale = VIEW_WH[0] / width
    cut = frame.left[top : top + height, left : left + width]
    view_wh = (VIEW_WH[0], round(height * scale))
    view = cv2.resize(cut, view_wh, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    geometry = frame.geometry.crop(left=left, top=top, size_wh=(width, height))
    projection = geometry.scale((scale, view_wh[1] / height), view_wh).P2
    draw_boxes(view, projection, found)
    draw_label_boxes(view, projection, labels)
    x1, y1, x2, y2 = (case.box - np.array([left, top, left, top])) * scale
    draw_outline(view, np.array([[x1, y1], [x2, y1], [x2, y2], [x1, y2]]), colour=case.colour, width=2)
    canvas = np.empty((CAPTION_PX + VIEW_WH[1], VIEW_WH[0] + BIRD_EYE_WIDTH_PX, 3), np.uint8)
    canvas[:] = BACKGROUND
    rows = min(view_wh[1], VIEW_WH[1])
    canvas[CAPTION_PX : CAPTION_PX + rows, : VIEW_WH[0]] = view[:rows]
    panel = BirdEyeView((BIRD_EYE_WIDTH_PX, canvas.shape[0])).draw(frame.geometry, found, labels)
    canvas[:, VIEW_WH[0] :] = panel
    draw_text(canvas, case.caption, (10, CAPTION_PX - 11), colour=TEXT, size_px=TEXT_PX)
    return canvas


def cut_around(box: NDArray[np.float64], size_wh: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height of what is shown: the box with room, in the view's shape, within the image."""
    shape = VIEW_WH[0] / VIEW_WH[1]
    wanted = max(MIN_CUT_PX, ROOM * float(box[2] - box[0]), ROOM * float(box[3] - box[1]) * shape)
    height = min(round(wanted / shape), size_wh[1])
    width = min(round(height * shape), size_wh[0])
    height = min(height, round(width / shape))
    left, top = (
        round(min(max(float(box[axis] + box[axis + 2]) / 2 - length / 2, 0), whole - length))
        for axis, length, whole in ((0, width, size_wh[0]), (1, height, size_wh[1]))
    )
    return left, top, width, height
