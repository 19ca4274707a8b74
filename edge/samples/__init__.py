"""Two small simulated drives with labels: one calibrates, the other measures, never the same frames."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from runtime.contracts.errors import SourceError

CALIBRATION_DRIVE = "calibration_drive"
MEASURING_DRIVE = "demo_drive"


def calibration_source() -> str:
    """URI of the bundled drive that calibrates INT8 and checks exports.

    Raises:
        SourceError: The package came without it.
    """
    return _source(CALIBRATION_DRIVE)


def measuring_source() -> str:
    """URI of the bundled drive that measures, streams and benchmarks.

    Raises:
        SourceError: The package came without it.
    """
    return _source(MEASURING_DRIVE)


def _source(name: str) -> str:
    folder = Path(str(files("edge.samples"))) / name
    if not (folder / "training").is_dir():
        raise SourceError(
            f"bundled recording {name}: found nothing at {folder}; expected a drive in tracking layout; "
            "name a source of your own, for example kitti-object:ROOT"
        )
    return f"kitti-tracking:{folder}"
