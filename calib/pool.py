"""Looks at a bounded number of a source's frames, one at a time, and keeps of each its hashes and its features."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import cv2
import numpy as np

from calib import object_features, scene_features
from calib.coverage import Points, comparable, distances
from calib.feature_cache import FeatureCache
from calib.finder import Finder
from calib.frame_hashes import FrameHashes, HashedFrame
from calib.frames import Check, ChosenFrame, Warn, accept_any, say_nothing, spread_indices
from calib.ranges import Progress, no_progress
from calib.scene_features import FeatureGroup, Row
from runtime.contracts.errors import FormatError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Objects3D

POOL_FACTOR, POOL_LEAST, POOL_MOST = 3, 60, 300
"""Frames looked at for each one wanted; at least so many; no more than these, unless more are wanted."""

LABELS, FOUND = "labels", "found by the float model"
"""Where objects come from, as records say it."""

_SCENE_ROWS = f"{scene_features.METHOD}, OpenCV {cv2.__version__}"


@dataclass(frozen=True, slots=True)
class Pool:
    """Frames that were looked at.

    Attributes:
        frames: their names, places and hashes, in the order of the source.
        between: (N, N) how different their scenes are.
        looked_at: which kinds of features were compared.
    """

    frames: tuple[ChosenFrame, ...]
    between: Points
    looked_at: tuple[str, ...]


def pool_size(wanted: int, available: int) -> int:
    """How many frames are looked at for ``wanted`` of ``available`` ones."""
    bounded = min(max(POOL_FACTOR * wanted, POOL_LEAST), POOL_MOST)
    return min(max(bounded, wanted), available)


def look_at(
    source: Sequence[StereoFrame],
    wanted: int,
    *,
    check: Check = accept_any,
    find: Finder | None = None,
    use_cache: bool = True,
    progress: Progress = no_progress,
    warn: Warn = say_nothing,
) -> Pool:
    """Reads the pool for a choice, spread evenly over a source.

    Objects are the labels where all frames of the pool have them, else what ``find`` finds, else they are left out.

    Args:
        source: Entered frames by index; ``labels(index)`` may give objects.
        wanted: How many frames will be chosen.
        check: Called with the camera of each frame; what it raises ends the looking.
        find: The float model, where it may be run.
        use_cache: Look for, and keep, features in the user's cache folder.
        progress: Told after every frame.
        warn: Told in one line why labels are not used.

    Raises:
        SourceError: There are no frames, or none is wanted.
    """
    spread_indices(len(source), wanted)
    indices = spread_indices(len(source), pool_size(wanted, len(source)))
    labels = _labels(source, indices, warn)
    finder = find if labels is None else None
    groups = scene_features.GROUPS
    frames: list[ChosenFrame] = []
    rows, object_rows = [], []
    with ExitStack() as stack:
        hashes = stack.enter_context(FrameHashes(source, enabled=use_cache))
        scenes = stack.enter_context(FeatureCache(_SCENE_ROWS, enabled=use_cache))
        found = None
        if finder is not None:
            found = stack.enter_context(FeatureCache(f"{object_features.METHOD} {finder.identity}", enabled=use_cache))

        def objects_row(frame: StereoFrame) -> Row:
            assert finder is not None
            return object_features.object_row(finder(frame))

        for done, index in enumerate(indices):
            seen = hashes[index]
            check(seen.geometry)
            chosen = seen.chosen
            frames.append(chosen)
            rows.append(_remembered(scenes, chosen.pixels, groups, seen, scene_features.scene_row))
            if found is not None:
                key = chosen.pixels + chosen.geometry
                object_rows.append(_remembered(found, key, object_features.GROUPS, seen, objects_row))
            progress("looking at frames", done + 1, len(indices))
    if labels is not None:
        object_rows = [object_features.object_row(item) for item in labels]
    table = np.array(rows, np.float32)
    looked_at = tuple(group.name for group in groups)
    if object_rows:
        table = np.concatenate([table, np.array(object_rows, np.float32)], axis=1)
        groups = (*groups, *object_features.GROUPS)
        origin = LABELS if labels is not None else FOUND
        looked_at += tuple(f"{group.name} ({origin})" for group in object_features.GROUPS)
    return Pool(tuple(frames), distances(comparable(table, groups)), looked_at)


def _remembered(
    cache: FeatureCache,
    key: str,
    groups: Sequence[FeatureGroup],
    seen: HashedFrame,
    compute: Callable[[StereoFrame], Row],
) -> Row:
    known = cache.get(key, size=sum(group.size for group in groups))
    if known is None:
        known = compute(seen.read())
        cache.put(key, known)
    return known


def _labels(source: Sequence[StereoFrame], indices: Sequence[int], warn: Warn) -> list[Objects3D] | None:
    """Labels of all these frames, or None where one has none."""
    read = getattr(source, "labels", None)
    if read is None:
        return None
    labels = []
    try:
        for index in indices:
            objects = read(index)
            if objects is None:
                return None
            labels.append(objects)
    except FormatError as error:
        warn(f"the choice of calibration frames goes without labels: {error}")
        return None
    return labels
