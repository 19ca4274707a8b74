"""Which frames of a source calibrate: one choice, made once, whose first few frames serve where a few are enough.

By ``coverage`` a bounded pool of frames, spread over the source, is looked at, and those are taken that bring the
whole pool nearest to a taken one. By ``farthest`` the odd ones come first. By ``spread`` frames lie at equal distances
in time, whatever they show.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from calib.coverage import Coverage, Order, coverage_order, distances, farthest_order, gap, score
from calib.finder import Finder
from calib.frame_hashes import FrameHashes
from calib.frames import (
    CalibrationSet,
    Check,
    Warn,
    accept_any,
    say_nothing,
    spread_indices,
)
from calib.pool import Pool, look_at
from calib.ranges import Progress, no_progress
from runtime.contracts.errors import FormatError
from runtime.contracts.frame import StereoFrame

METHODS = ("coverage", "farthest", "spread")
DEFAULT_METHOD = "coverage"


@dataclass(frozen=True, slots=True)
class Choice:
    """Chosen frames with the source that they are read from again, while that is open.

    Attributes:
        chosen: the record.
        source: frames by index.
    """

    chosen: CalibrationSet
    source: Sequence[StereoFrame]

    def frames(self, few: int | None = None) -> Iterator[StereoFrame]:
        """Reads the chosen frames, or only the first few, one at a time."""
        for frame in self.chosen.frames[:few]:
            yield self.source[frame.index]


def choose(
    source: Sequence[StereoFrame],
    wanted: int,
    *,
    name: str,
    method: str = DEFAULT_METHOD,
    check: Check = accept_any,
    find: Finder | None = None,
    use_cache: bool = True,
    progress: Progress = no_progress,
    warn: Warn = say_nothing,
) -> Choice:
    """Chooses calibration frames.

    Args:
        source: Entered frames by index.
        wanted: How many frames; fewer where it has fewer.
        name: What the record calls the source.
        method: One of `METHODS`.
        check: Called with the camera of each frame that is looked at; what it raises ends the choice.
        find: Finds objects, for sources without labels; None to compare pixels alone.
        use_cache: Look for, and keep, features in the user's cache folder.
        progress: Told how far the looking is.
        warn: Told in one line what is odd.

    Raises:
        SourceError: There are no frames, or none is wanted.
        FormatError: No such method.
    """
    if method not in METHODS:
        raise FormatError(f"--choice: found {method!r}; expected one of {', '.join(METHODS)}; choose one of these")
    if method == "spread":
        taken = []
        indices = spread_indices(len(source), wanted)
        with FrameHashes(source, enabled=use_cache) as hashes:
            for place in _time_order(indices):
                seen = hashes[indices[place]]
                check(seen.geometry)
                taken.append(seen.chosen)
        return Choice(CalibrationSet(name, tuple(taken), len(source), method), source)
    pool = look_at(source, wanted, check=check, find=find, use_cache=use_cache, progress=progress, warn=warn)
    return choose_from(pool, source, wanted, name=name, method=method)


def choose_from(pool: Pool, source: Sequence[StereoFrame], wanted: int, *, name: str, method: str) -> Choice:
    """As `choose`, from a pool that was looked at; ``spread`` is spread over the pool."""
    even = spread_indices(len(pool.frames), wanted)
    if method == "spread":
        order: Order = tuple(even[place] for place in _time_order(even))
    elif method == "farthest":
        order = farthest_order(pool.between, wanted)
    else:
        order = coverage_order(pool.between, wanted)
    coverage = Coverage(
        score=score(pool.between, order),
        even_score=score(pool.between, even),
        gap=gap(pool.between, order),
        pool=len(pool.frames),
        looked_at=pool.looked_at,
    )
    frames = tuple(pool.frames[row] for row in order)
    return Choice(CalibrationSet(name, frames, len(source), method, coverage), source)


def _time_order(indices: Sequence[int]) -> Order:
    """Places of ascending indices in an order whose every first part is spread over time."""
    between = distances(np.array(indices, np.float64)[:, None])
    return farthest_order(between, len(indices))
