"""Whether frames that measure calibrated, too, or were taken a moment before or after some that did."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

from calib.frame_hashes import FrameHashes
from calib.frames import CalibrationSet
from runtime.contracts.frame import StereoFrame

NEAR_FRAMES = 10
"""A second at camera rate: what is seen then is the same street with the same cars."""
_NUMBERED_IN_DRIVE = re.compile(r"(?P<drive>.+)/(?P<number>\d+)")
_NUMBERED = re.compile(r"(?:(?P<drive>.+)/)?(?P<number>\d+)")


def overlap(
    calibration: CalibrationSet, measuring: Sequence[StereoFrame], *, use_cache: bool = True
) -> tuple[str, ...]:
    """Ids of measuring frames whose pixels calibrated, too.

    Args:
        calibration: The choice.
        measuring: Entered frames by index.
        use_cache: Look for, and keep, hashes of frames in the user's cache folder.

    Raises:
        FrameError: An image is missing, broken or of another size.
        FormatError: A calibration is wrong.
    """
    known = {frame.pixels for frame in calibration.frames}
    with FrameHashes(measuring, enabled=use_cache) as hashes:
        seen = [hashes[index].chosen for index in range(len(measuring))]
    return tuple(frame.frame_id for frame in seen if frame.pixels in known)


def neighbours(
    calibration: CalibrationSet, frame_ids: Iterable[str], *, near: int = NEAR_FRAMES, one_drive: bool = False
) -> tuple[str, ...]:
    """Ids ``drive/number`` within ``near`` frames of a calibration frame of the same drive, itself included.

    Args:
        calibration: The choice.
        frame_ids: Of the same recording.
        near: How many frames away counts as a neighbour.
        one_drive: Numbers without a drive are of one drive; else they say nothing, as KITTI's object frames are
            shuffled.
    """
    named_frame = _NUMBERED if one_drive else _NUMBERED_IN_DRIVE
    numbers: dict[str | None, list[int]] = {}
    for frame in calibration.frames:
        named = named_frame.fullmatch(frame.frame_id)
        if named is not None:
            numbers.setdefault(named["drive"], []).append(int(named["number"]))
    found = []
    for frame_id in frame_ids:
        named = named_frame.fullmatch(frame_id)
        if named is None:
            continue
        if any(abs(int(named["number"]) - number) <= near for number in numbers.get(named["drive"], ())):
            found.append(frame_id)
    return tuple(found)
