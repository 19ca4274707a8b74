"""Frames that calibrate must not measure: refused where `edge quantize` is told both, else said."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edge.cli.stages import warn

if TYPE_CHECKING:
    from calib.frames import CalibrationSet

_OF_ONE_DRIVE = ("kitti-raw:", "video:")
"""Sources whose frames are bare numbers, one after another."""


def refuse_overlap(chosen: CalibrationSet, validation: str, *, allow: bool, use_cache: bool) -> None:
    """Compares the pixels of calibration and validation frames before minutes go by.

    Args:
        chosen: The calibration frames.
        validation: URI of the frames that measure.
        allow: Warn instead.
        use_cache: Look for, and keep, hashes of frames in the user's cache folder.

    Raises:
        QuantizeError: A frame does both.
    """
    from calib.overlap import overlap
    from edge.cli.source_names import public_name
    from quantize.errors import QuantizeError
    from runtime.sources.factory import open_sequence

    name = public_name(validation)
    with open_sequence(validation) as source:
        if allow:
            warn_of_overlap(chosen, source, name=name, use_cache=use_cache)
            return
        shared = overlap(chosen, source, use_cache=use_cache)
        if shared:
            raise QuantizeError(
                f"--validation: found {len(shared)} frames that calibrate, too (the first is {shared[0]}); expected "
                "other frames, since the figures would flatter INT8; name another source or split, or pass "
                "--allow-overlap"
            )
        _warn_of_neighbours(chosen, source, name=name)


def warn_of_calibrated(models: Sequence[Path], source: Any, *, uri: str) -> None:
    """One line a model that was calibrated, by what its directory says, on frames of an entered source.

    Raises:
        FormatError: A directory's record of its calibration frames is damaged.
    """
    from calib.choice_record import read_choice
    from edge.cli.source_names import public_name

    for path in models:
        chosen = read_choice(path)
        if chosen is not None:
            warn_of_overlap(
                chosen,
                source,
                name=public_name(uri),
                use_cache=False,
                tell=lambda line, path=path: warn(f"{path}: {line}"),
            )


def warn_of_overlap(
    chosen: CalibrationSet, source: Any, *, name: str, use_cache: bool = True, tell: Callable[[str], None] = warn
) -> None:
    """One line where frames of an entered source calibrated, too, or were taken next to some that did."""
    from calib.overlap import overlap

    shared = overlap(chosen, source, use_cache=use_cache)
    if shared:
        tell(
            f"{len(shared)} of the measured frames calibrated, too (the first is {shared[0]}): "
            "the figures flatter INT8; measure on other frames"
        )
        return
    _warn_of_neighbours(chosen, source, name=name, tell=tell)


def _warn_of_neighbours(chosen: CalibrationSet, source: Any, *, name: str, tell: Callable[[str], None] = warn) -> None:
    from calib.overlap import NEAR_FRAMES, neighbours

    if chosen.source.partition("?")[0] != name.partition("?")[0]:
        return  # the same numbers of another recording
    frame_ids = (source.frame_id(index) for index in range(len(source)))
    near = neighbours(chosen, frame_ids, one_drive=chosen.source.startswith(_OF_ONE_DRIVE))
    if near:
        tell(
            f"{len(near)} of the measured frames lie within {NEAR_FRAMES} frames of one that calibrates, in the same "
            f"drive (the first is {near[0]}): the figures may flatter INT8; measure on another drive"
        )
