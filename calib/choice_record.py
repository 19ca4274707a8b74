"""``calibration.json``: the choice of frames, written down in the INT8 model directory.

Whoever gets the directory can tell which frames its ranges come from, whether theirs are among them, and how well
they stand for the source. A reader takes what it knows and ignores the rest, so that a newer file still says what
an older reader asks.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from calib.coverage import Coverage
from calib.frames import CalibrationSet, ChosenFrame
from calib.scene_features import METHOD
from runtime.contracts.errors import FormatError
from runtime.model_folder import CALIBRATION_FILE

SCHEMA = 1


def choice_text(chosen: CalibrationSet) -> str:
    """The file's text."""
    coverage = chosen.coverage
    content = {
        "schema": SCHEMA,
        "source": chosen.source,
        "available": chosen.available,
        "method": chosen.method,
        "features": None if coverage is None else METHOD,
        "coverage": None
        if coverage is None
        else {
            "score": round(coverage.score, 6),
            "even_score": round(coverage.even_score, 6),
            "gap": round(coverage.gap, 6),
            "pool": coverage.pool,
            "looked_at": list(coverage.looked_at),
        },
        "pixels_sha256": chosen.digest,
        "geometry_sha256": chosen.geometry_digest,
        "frames": [
            {"frame_id": item.frame_id, "index": item.index, "pixels": item.pixels, "geometry": item.geometry}
            for item in chosen.frames
        ],
    }
    return json.dumps(content, indent=1) + "\n"


def parse_choice(text: str, *, where: str = CALIBRATION_FILE) -> CalibrationSet:
    """The choice that a file's text tells; keys that it does not know are ignored, missing ones get a neutral value.

    Args:
        text: Of the file.
        where: What an error calls it.

    Raises:
        FormatError: This is no record of a choice.
    """
    try:
        content = json.loads(text)
        frames = tuple(
            ChosenFrame(
                str(item["frame_id"]), int(item.get("index", -1)), str(item["pixels"]), str(item.get("geometry", ""))
            )
            for item in content["frames"]
        )
        return CalibrationSet(
            source=str(content.get("source", "")),
            frames=frames,
            available=int(content.get("available", 0)),
            method=str(content.get("method", "")),
            coverage=_coverage(content.get("coverage")),
        )
    except (ValueError, OverflowError, KeyError, TypeError, AttributeError) as error:
        raise FormatError(
            f"{where}: found no record of calibration frames ({type(error).__name__}: {error}); expected "
            "what `edge quantize` writes; quantise the model again"
        ) from error


def read_choice(folder: Path) -> CalibrationSet | None:
    """The choice written down in a model directory; None where it has none.

    Raises:
        FormatError: The file is there and damaged.
    """
    path = folder / CALIBRATION_FILE
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return None
    return parse_choice(text, where=str(path))


def _coverage(content: Any) -> Coverage | None:
    if not isinstance(content, dict) or "score" not in content:
        return None
    return Coverage(
        score=float(content["score"]),
        even_score=float(content.get("even_score", 0.0)),
        gap=float(content.get("gap", 0.0)),
        pool=int(content.get("pool", 0)),
        looked_at=tuple(str(item) for item in content.get("looked_at", ())),
    )
