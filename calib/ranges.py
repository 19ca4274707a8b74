"""Runs the float model over the calibration frames and collects statistics of its inner tensors.

The wanted tensors become outputs of a copy of the graph. Where all of them together would be large, the
work is split into groups of tensors, one session and one pass over the frames a group, so that memory stays
bounded whatever the network and however many frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from calib.methods import Range, tensor_range
from calib.observers import ChannelExtremes, StreamingHistogram, TensorStatistics
from runtime.contracts.errors import FormatError
from runtime.session import open_session

if TYPE_CHECKING:
    import onnx

Feeds = Mapping[str, NDArray[Any]]
Progress = Callable[[str, int, int], None]
"""Told the stage, how many steps are done, and how many there are."""

GROUP_BYTES = 1 << 30
"""Activations that one run may hold at once."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What calibration saw.

    Attributes:
        tensors: statistics by tensor.
        channels: (C,) minima and maxima by tensor, for those whose channels are quantised one by one.
        frames: how many frames were run.
    """

    tensors: dict[str, TensorStatistics]
    channels: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = field(default_factory=dict)
    frames: int = 0

    def ranges(self, method: str) -> dict[str, Range]:
        """(low, high) of each tensor by one of `calib.methods.METHODS`."""
        return {name: tensor_range(statistics, method) for name, statistics in self.tensors.items()}


def no_progress(stage: str, done: int, total: int) -> None:
    """Tells nobody."""


def observe(
    model: onnx.ModelProto,
    feeds: Callable[[], Iterable[Feeds]],
    *,
    tensors: Sequence[str],
    channel_tensors: Sequence[str] = (),
    bytes_of: Mapping[str, int] | None = None,
    frame_count: int = 0,
    progress: Progress = no_progress,
) -> Observation:
    """Runs the model on every frame and observes tensors.

    Args:
        model: The float model.
        feeds: Starts an iteration over the frames' feeds; called once a group.
        tensors: Names of float tensors to take statistics of.
        channel_tensors: Names of tensors whose channel extremes are wanted.
        bytes_of: Size of each tensor, for grouping; unknown ones count as nothing.
        frame_count: How many frames to expect, for progress alone.
        progress: Called after every frame.

    Returns:
        The observation.

    Raises:
        FormatError: There was no frame, or a value was not finite.
    """
    found = observe_prefixes(
        model,
        feeds,
        counts=(),
        tensors=tensors,
        channel_tensors=channel_tensors,
        bytes_of=bytes_of,
        frame_count=frame_count,
        progress=progress,
    )
    return found[max(found)]


def observe_prefixes(
    model: onnx.ModelProto,
    feeds: Callable[[], Iterable[Feeds]],
    *,
    counts: Sequence[int],
    tensors: Sequence[str],
    channel_tensors: Sequence[str] = (),
    bytes_of: Mapping[str, int] | None = None,
    frame_count: int = 0,
    progress: Progress = no_progress,
) -> dict[int, Observation]:
    """As `observe`, with what was seen after the first few frames, too: one run for a whole curve.

    Args:
        model: The float model.
        feeds: As `observe`.
        counts: After how many frames to note what was seen; those beyond the last frame are left out.
        tensors: As `observe`.
        channel_tensors: As `observe`.
        bytes_of: As `observe`.
        frame_count: As `observe`.
        progress: As `observe`.

    Returns:
        Observation by number of frames; that of all frames always among them.

    Raises:
        FormatError: As `observe`.
    """
    histograms = {name: StreamingHistogram() for name in tensors}
    channels = {name: ChannelExtremes() for name in channel_tensors}
    wanted = list(dict.fromkeys([*tensors, *channel_tensors]))
    groups = split_groups(wanted, bytes_of or {})
    seen: dict[int, Observation] = {}

    def note(group: Sequence[str], frames: int) -> None:
        noted = seen.setdefault(frames, Observation({}, {}, frames))
        noted.tensors.update({name: histograms[name].statistics() for name in group if name in histograms})
        noted.channels.update({name: channels[name].extremes() for name in group if name in channels})

    frames = 0
    for number, group in enumerate(groups):
        stage = "calibrating" if len(groups) == 1 else f"calibrating, part {number + 1} of {len(groups)}"
        frames = 0
        with open_session(with_outputs(model, group), name="float model with inner tensors") as session:
            for feed in feeds():
                for name, values in zip(group, session.run(feed, outputs=group), strict=True):
                    if name in histograms:
                        histograms[name].update(values, name=name)
                    if name in channels:
                        channels[name].update(values)
                frames += 1
                if frames in counts:
                    note(group, frames)
                progress(stage, frames, max(frame_count, frames))
        if frames > 0:
            note(group, frames)
    if frames == 0:
        raise FormatError("calibration: found no frames; expected one or more; give a source with frames")
    return seen


def split_groups(names: Sequence[str], bytes_of: Mapping[str, int], limit_bytes: int = GROUP_BYTES) -> list[list[str]]:
    """Cuts a list of tensors into groups of at most ``limit_bytes``; a larger tensor stands alone."""
    groups: list[list[str]] = [[]]
    held = 0
    for name in names:
        size = bytes_of.get(name, 0)
        if groups[-1] and held + size > limit_bytes:
            groups.append([])
            held = 0
        groups[-1].append(name)
        held += size
    return groups if groups[0] else []


def with_outputs(model: onnx.ModelProto, names: Sequence[str]) -> bytes:
    """A copy of the model, as bytes, that gives the named float tensors as further outputs."""
    import onnx

    copy = onnx.ModelProto()
    copy.CopyFrom(model)
    present = {item.name for item in copy.graph.output}
    for name in names:
        if name not in present:
            copy.graph.output.append(onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, None))
    serialised: bytes = copy.SerializeToString()
    return serialised
