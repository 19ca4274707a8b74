"""Ranges chosen by what they do to the network's outputs.

Range methods look at one tensor and weigh its rounding against its clipping alike. At the outputs they are not alike:
rounding errors of neighbouring values are unrelated and average out in the sums that follow, clipped peaks all err to
the same side; and the low end of a residual that a ReLU cuts off behind the addition may be clipped for nothing. So
the best method for this network is the start, and then one tensor after another is given a few other ranges, and keeps
one that brings the outputs closer (`quantize.output_error`). Every tensor is tried once, then those that changed the
outputs most, as far as the work allowed goes. Work is counted in multiply-adds, not in seconds: the same frames give
the same file, however busy the machine. It costs nothing at run time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calib.cache import load, store
from calib.choice import Choice
from calib.frames import frame_feeds
from calib.methods import METHODS, Range
from calib.observers import TensorStatistics
from calib.ranges import Feeds, Observation, Progress, no_progress
from quantize.calibration import Calibration, run_key
from quantize.output_error import OutputError
from quantize.prepare import Prepared
from quantize.qdq import nearest_levels
from quantize.static import build

SEARCH = "search"
"""What the command line calls it, beside the range methods."""
SEARCH_FRAMES = 4
MOST_MULTIPLY_ADDS = 8e12
"""Of all trials together: everything is tried of `compact`, only the methods of a network many times as heavy."""
_SMALLEST_GAIN = 1e-3
"""Relative; less is the luck of a few frames."""
_NO_ERROR = float(np.finfo(np.float64).tiny)
_SAME = 0.02
"""Two ranges that differ by less than this part of their width are one."""
_SHRINKS = ((0.8, 0.8), (0.7, 1.0), (0.9, 0.9), (1.0, 0.8))
"""Of the low and the high end."""
_STAGE = "searching ranges"
_WAY = "2"
"""Of searching, for the cache: another number for another way."""
_METHOD = "begun with "


@dataclass(frozen=True, slots=True)
class RangeSearch:
    """What was found.

    Attributes:
        ranges: by tensor.
        method: the range method that they come from; of a search, that which it began with, the best of all.
        first_error: at the outputs with that method (`OutputError.of`); None where nothing was searched.
        error: with the ranges found.
        trials: how many graphs were run.
    """

    ranges: dict[str, Range]
    method: str
    first_error: float | None
    error: float | None
    trials: int

    @property
    def name(self) -> str:
        """For manifests and reports."""
        return self.method if self.trials == 0 else f"{SEARCH} from {self.method}"


def settled_ranges(
    prepared: Prepared,
    calibration: Calibration,
    choice: Choice,
    method: str,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> RangeSearch:
    """Ranges by a method of `calib.methods`, or by search on the first few calibration frames.

    Args:
        prepared: The float model.
        calibration: Of its whole placement.
        choice: The calibration frames, their source still entered.
        method: One of `calib.methods.METHODS`, or `SEARCH`.
        use_cache: Look for, and keep, what a search found in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every trial.
    """
    observation = calibration.observation
    if method != SEARCH:
        return RangeSearch(observation.ranges(method), method, None, None, 0)
    few = calibration.frames.first(SEARCH_FRAMES)
    plain = build(prepared, observation, observation.ranges(next(iter(METHODS)))).model
    settings = (SEARCH, _WAY, f"{MOST_MULTIPLY_ADDS:g}", calibration.frames.digest, calibration.frames.geometry_digest)
    key = run_key(prepared, plain, few, tensors=settings)
    known = load(key) if use_cache else None
    if known is None:
        feeds = list(
            frame_feeds(choice.frames(SEARCH_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig)
        )
        known = _packed(search_ranges(prepared, observation, feeds, progress=progress))
        if use_cache:
            store(key, known)
    return _unpacked(known)


def search_ranges(
    prepared: Prepared,
    observation: Observation,
    feeds: Sequence[Feeds],
    *,
    most_multiply_adds: float = MOST_MULTIPLY_ADDS,
    progress: Progress = no_progress,
) -> RangeSearch:
    """Finds ranges for the tensors of a placement.

    Args:
        prepared: The float model.
        observation: Its calibration.
        feeds: A few calibration frames, more than one.
        most_multiply_adds: No range is tried that would exceed it; the methods themselves always are.
        progress: Told after every trial.
    """
    measure = OutputError(prepared.model, feeds)
    by_method = {method: observation.ranges(method) for method in METHODS}
    tensors = list(prepared.placement.observed)
    affordable = int(most_multiply_adds / max(1, len(feeds) * sum(prepared.products.values())))
    planned = max(len(METHODS), min(len(METHODS) + 2 * len(tensors), affordable))
    levels = nearest_levels(prepared.model, prepared.placement, prepared.recipe)
    trials = 0

    def errors_of(ranges: Mapping[str, Range], rival: Sequence[float] = ()) -> list[float]:
        nonlocal trials
        found = measure.by_frame(build(prepared, observation, ranges, levels=levels).model, rival=rival)
        trials += 1
        progress(_STAGE, trials, planned)
        return found

    errors = {method: errors_of(ranges) for method, ranges in by_method.items()}
    method = min(errors, key=lambda name: sum(errors[name]))
    best, best_errors = dict(by_method[method]), errors[method]
    waiting = {
        name: _candidates(best[name], [ranges[name] for ranges in by_method.values()], observation.tensors[name])
        for name in tensors
    }
    effect = dict.fromkeys(tensors, 0.0)

    def attempt(name: str) -> None:
        nonlocal best, best_errors
        changed = {**best, name: waiting[name].pop(0)}
        found = errors_of(changed, best_errors)
        ratio = sum(found) / max(sum(best_errors[: len(found)]), _NO_ERROR)
        effect[name] = max(effect[name], abs(ratio - 1) * sum(best_errors))
        if len(found) == len(feeds) and ratio < 1 - _SMALLEST_GAIN:
            best, best_errors = changed, found

    for name in tensors:
        if waiting[name] and trials < planned:
            attempt(name)
    while trials < planned and (open_tensors := [name for name in tensors if waiting[name]]):
        loudest = max(open_tensors, key=lambda name: effect[name])
        attempt(loudest)
        effect[loudest] /= 2  # the next one's turn comes, too
    progress(_STAGE, planned, planned)
    return RangeSearch(best, method, sum(errors[method]), sum(best_errors), trials)


def _candidates(current: Range, methods: Sequence[Range], statistics: TensorStatistics) -> list[Range]:
    """Other ranges worth a trial: the methods' own, the widest first, then narrower ones."""
    low, high = current
    wanted = sorted(methods, key=lambda item: item[0] - item[1])
    wanted += [(low * down, high * up) for down, up in _SHRINKS if low < 0 or down == up]
    found = [current]
    for item in wanted:
        clipped = (max(item[0], statistics.minimum), min(item[1], statistics.maximum))
        if all(_differ(clipped, other) for other in found):
            found.append(clipped)
    return found[1:]


def _differ(one: Range, other: Range) -> bool:
    width = max(one[1] - one[0], other[1] - other[0])
    return max(abs(one[0] - other[0]), abs(one[1] - other[1])) > _SAME * width


def _packed(found: RangeSearch) -> Observation:
    """As the cache keeps it: a range is the extremes of one channel."""
    numbers = {
        name: (np.array([low], np.float32), np.array([high], np.float32)) for name, (low, high) in found.ranges.items()
    }
    errors = np.array([found.first_error], np.float32), np.array([found.error], np.float32)
    return Observation({}, {f"{_METHOD}{found.method}": errors, **numbers}, found.trials)


def _unpacked(kept: Observation) -> RangeSearch:
    title, (first_error, error) = next(iter(kept.channels.items()))
    ranges = {name: (float(low[0]), float(high[0])) for name, (low, high) in kept.channels.items() if name != title}
    return RangeSearch(ranges, title.removeprefix(_METHOD), float(first_error[0]), float(error[0]), kept.frames)
