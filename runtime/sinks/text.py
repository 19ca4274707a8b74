"""Text in pictures: OpenCV's outline font where it has one (5.0), its stroke font before."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.sinks.palette import Colour

REGULAR, BOLD = 400, 650
_STROKE_FONT = cv2.FONT_HERSHEY_DUPLEX
_STROKE_UNIT_PX = 30.0
"""Height of the stroke font's capitals, with some air, at scale 1."""

_outline: Any = cv2.FontFace("sans") if hasattr(cv2, "FontFace") else None


def draw_text(
    image: NDArray[np.uint8],
    text: str,
    at_xy: tuple[float, float],
    *,
    colour: Colour,
    size_px: int,
    weight: int = REGULAR,
) -> int:
    """Writes on the image, baseline and left edge at ``at_xy``; returns the width in pixels."""
    origin = (round(at_xy[0]), round(at_xy[1]))
    if _outline is not None:
        cv2.putText(image, text, origin, colour, _outline, size_px, weight)
    else:
        thickness = 2 if weight > REGULAR and size_px > 18 else 1
        cv2.putText(image, text, origin, _STROKE_FONT, size_px / _STROKE_UNIT_PX, colour, thickness, cv2.LINE_AA)
    return text_width(text, size_px=size_px, weight=weight)


def text_width(text: str, *, size_px: int, weight: int = REGULAR) -> int:
    """Width of a text in pixels."""
    if _outline is not None:
        box = cv2.getTextSize((0, 0), text, (0, 0), _outline, size_px, weight)
        return int(box[0] + box[2])
    (width, _), _ = cv2.getTextSize(text, _STROKE_FONT, size_px / _STROKE_UNIT_PX, 1)
    return int(width)
