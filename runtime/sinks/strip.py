"""The strip under the camera image: what ran, which frame, what was counted, how long it took."""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from runtime.sinks.base import FrameResult
from runtime.sinks.palette import ACCENT, BACKGROUND, DIM_TEXT, GRID, LABEL, TEXT, class_colour
from runtime.sinks.shapes import draw_line, draw_outline, fill_chip
from runtime.sinks.text import BOLD, draw_text, text_width

HISTORY_FRAMES = 120
MARGIN_PX = 24
STAGE_ROW_PX = 22
TITLE_PX, SMALLEST_TITLE_PX = 24, 12
SHOWN_STAGES = ("read", "preprocess", "inference", "decode", "refine")

Image = NDArray[np.uint8]


class StatusStrip:
    """Keeps the recent latencies for the curve."""

    def __init__(self, title: str, class_names: tuple[str, ...]) -> None:
        """Takes what stays the same: the model's name and its classes."""
        self._title = title
        self._class_names = class_names
        self._totals_ms: deque[float] = deque(maxlen=HISTORY_FRAMES)

    def draw(self, result: FrameResult, size_wh: tuple[int, int]) -> Image:
        """The strip of one frame, (height, width, 3) uint8 BGR."""
        strip = np.empty((size_wh[1], size_wh[0], 3), np.uint8)
        strip[:] = BACKGROUND
        self._totals_ms.append(result.latency_ms.get("total", 0.0))
        third = (size_wh[0] - 2 * MARGIN_PX) // 3
        self._draw_facts(strip, result, room=third)
        self._draw_stages(strip, result, left=MARGIN_PX + third + third // 6)
        self._draw_curve(strip, left=MARGIN_PX + 2 * third, right=size_wh[0] - MARGIN_PX)
        return strip

    def _draw_facts(self, strip: Image, result: FrameResult, *, room: int) -> None:
        size_px = TITLE_PX
        while size_px > SMALLEST_TITLE_PX and text_width(self._title, size_px=size_px, weight=BOLD) > room:
            size_px -= 1
        draw_text(strip, self._title, (MARGIN_PX, 44), colour=TEXT, size_px=size_px, weight=BOLD)
        frame = f"frame {result.frame.frame_id}   {result.frame.timestamp_secs:.1f} s"
        draw_text(strip, frame, (MARGIN_PX, 74), colour=DIM_TEXT, size_px=16)
        x, y = MARGIN_PX, 112
        counts = np.bincount(result.detections.class_id, minlength=len(self._class_names))
        for name, count in zip(self._class_names, counts, strict=True):
            fill_chip(strip, (x, y - 13), (14, 14), colour=class_colour(name))
            x += 22
            x += draw_text(strip, f"{name} ", (x, y), colour=DIM_TEXT, size_px=16) + 6
            x += draw_text(strip, str(count), (x, y), colour=TEXT, size_px=16, weight=BOLD) + 20
        if result.labels is not None:
            square = np.array([[0.0, 0.0], [14.0, 0.0], [14.0, 14.0], [0.0, 14.0]]) + np.array([MARGIN_PX, y + 17])
            draw_outline(strip, square, colour=LABEL)
            draw_text(strip, "label (truth)", (MARGIN_PX + 22, y + 30), colour=DIM_TEXT, size_px=16)

    def _draw_stages(self, strip: Image, result: FrameResult, *, left: int) -> None:
        stages = [(name, result.latency_ms[name]) for name in SHOWN_STAGES if name in result.latency_ms]
        longest = max((value for _, value in stages), default=1.0)
        y = 44
        for name, value in stages:
            draw_text(strip, name, (left, y), colour=DIM_TEXT, size_px=15)
            bar = max(round(120 * value / max(longest, 1e-9)), 2)
            fill_chip(strip, (left + 96, y - 11), (bar, 10), colour=GRID if value < longest else ACCENT)
            draw_text(strip, f"{value:.1f} ms", (left + 100 + bar + 8, y), colour=TEXT, size_px=15)
            y += STAGE_ROW_PX + 6

    def _draw_curve(self, strip: Image, *, left: int, right: int) -> None:
        values = np.array(self._totals_ms)
        top, bottom = 66.0, strip.shape[0] - 26.0
        median = float(np.median(values))
        text = f"{values[-1]:.0f} ms"
        shift = draw_text(strip, text, (left, 44), colour=TEXT, size_px=24, weight=BOLD) + 14
        draw_text(strip, f"a frame, median {median:.0f} ms", (left + shift, 44), colour=DIM_TEXT, size_px=15)
        for y in (top, bottom):
            draw_line(strip, np.array([left, y]), np.array([right, y]), colour=GRID)
        ceiling = max(float(values.max()) * 1.15, 1.0)
        columns = right - (len(values) - 1 - np.arange(len(values))) * (right - left) / (HISTORY_FRAMES - 1)
        rows = bottom - (bottom - top) * values / ceiling
        points = np.stack([columns, rows], axis=1)
        if len(points) > 1:
            draw_outline(strip, points, colour=ACCENT, width=2, closed=False)
