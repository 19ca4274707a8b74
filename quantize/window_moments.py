"""Second moments of what convolutions read, window by window.

A convolution multiplies each window of its input, flattened to x, with its weights. What an error e of the weights
does to the output has the mean square e E[x x'] e', so the matrix E[x x'] is all that rounding needs to know of the
frames. It is taken over a sample of windows: neighbouring windows say nearly the same.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import onnx
from numpy.typing import NDArray

from calib.ranges import Feeds, Progress, no_progress, split_groups, with_outputs
from quantize.errors import QuantizeError
from quantize.graph import attribute
from runtime.session import open_session

WINDOWS = 1024
"""Of each frame."""
MOST_INPUTS = 2304
"""Inputs whose moments are taken together; a wider window is cut into parts that are taken for unrelated."""
_STAGE = "looking at what convolutions read"
_SEED = 0


@dataclass(frozen=True, slots=True)
class MomentBlock:
    """A part of a convolution's weights whose inputs are looked at together.

    Attributes:
        rows: output channels.
        columns: of the window, flattened as [channels of the group, kernel height, kernel width].
        moments: (K, K) mean of x x' over windows.
    """

    rows: slice
    columns: slice
    moments: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Window:
    """Geometry of a 2D convolution."""

    kernel: tuple[int, int]
    strides: tuple[int, int]
    dilations: tuple[int, int]
    pads: tuple[int, int, int, int]
    groups: int

    @property
    def span(self) -> tuple[int, int]:
        """Rows and columns from a window's first input to its last, both counted."""
        return (
            (self.kernel[0] - 1) * self.dilations[0] + 1,
            (self.kernel[1] - 1) * self.dilations[1] + 1,
        )


def window_moments(
    model: onnx.ModelProto,
    convolutions: Sequence[onnx.NodeProto],
    weight_shapes: Mapping[str, tuple[int, ...]],
    feeds: Callable[[], Iterable[Feeds]],
    *,
    bytes_of: Mapping[str, int] | None = None,
    frame_count: int = 0,
    progress: Progress = no_progress,
) -> Iterator[tuple[str, list[MomentBlock]]]:
    """Runs the model and takes the moments of each convolution's windows, as many convolutions at once as memory holds.

    Args:
        model: The float model.
        convolutions: 2D convolutions of it, with explicit padding.
        weight_shapes: Convolution -> (M, C / groups, kernel height, kernel width).
        feeds: Starts an iteration over the frames' feeds; called once a group of tensors.
        bytes_of: Size of each tensor, for grouping; unknown ones count as nothing.
        frame_count: How many frames to expect, for progress alone.
        progress: Told after every frame.

    Yields:
        A convolution, and blocks that together cover its weights.

    Raises:
        QuantizeError: There are no frames.
    """
    parts = {
        node.name: _parts(weight_shapes[node.name], window_of(node, weight_shapes[node.name])) for node in convolutions
    }
    readers: dict[str, list[onnx.NodeProto]] = {}
    for node in convolutions:
        readers.setdefault(node.input[0], []).append(node)
    held = {
        tensor: (bytes_of or {}).get(tensor, 0) + sum(_moment_bytes(parts[node.name]) for node in nodes)
        for tensor, nodes in readers.items()
    }
    groups = split_groups(list(readers), held)
    for number, group in enumerate(groups):
        sums: dict[str, list[NDArray[np.float32]]] = {}
        frames = 0
        with open_session(with_outputs(model, group), name="float model with inner tensors") as session:
            for feed in feeds():
                frames += 1
                for name, values in zip(group, session.run(feed, outputs=group), strict=True):
                    for node in readers[name]:
                        _add(sums, node, values, window_of(node, weight_shapes[node.name]), parts[node.name], frames)
                progress(f"{_STAGE}, part {number + 1} of {len(groups)}", frames, max(frame_count, frames))
        if frames == 0:
            raise QuantizeError("rounding: found no frames; expected one or more; give a source with frames")
        for name in list(sums):
            yield (
                name,
                [
                    MomentBlock(rows, columns, total / np.float32(frames))
                    for (rows, _, columns), total in zip(parts[name], sums.pop(name), strict=True)
                ],
            )


def _add(
    sums: dict[str, list[NDArray[np.float32]]],
    node: onnx.NodeProto,
    values: NDArray[np.float32],
    window: Window,
    parts: Sequence[tuple[slice, int, slice]],
    frame: int,
) -> None:
    """Adds the mean over a frame's windows to a convolution's sums."""
    windows = sampled_windows(values, window, np.random.default_rng((_SEED, frame)))
    found = [windows[:, group, columns] for _, group, columns in parts]
    moments = [part.T @ part / np.float32(len(part)) for part in found]
    if node.name not in sums:
        sums[node.name] = moments
        return
    for total, moment in zip(sums[node.name], moments, strict=True):
        total += moment


def sampled_windows(
    values: NDArray[np.float32], window: Window, chance: np.random.Generator, count: int = WINDOWS
) -> NDArray[np.float32]:
    """(P, groups, K) windows of an input (B, C, H, W), at most ``count`` of them, none twice."""
    top, left, bottom, right = window.pads
    padded = np.pad(values, ((0, 0), (0, 0), (top, bottom), (left, right)))
    size = [(padded.shape[axis + 2] - window.span[axis]) // window.strides[axis] + 1 for axis in range(2)]
    places = len(values) * size[0] * size[1]
    chosen = np.sort(chance.choice(places, min(count, places), replace=False))
    image, row, column = np.unravel_index(chosen, (len(values), *size))
    rows = row[:, None] * window.strides[0] + np.arange(window.kernel[0]) * window.dilations[0]
    columns = column[:, None] * window.strides[1] + np.arange(window.kernel[1]) * window.dilations[1]
    taken = padded[image[:, None, None], :, rows[:, :, None], columns[:, None, :]]  # (P, kh, kw, C)
    return np.ascontiguousarray(taken.transpose(0, 3, 1, 2)).reshape(len(chosen), window.groups, -1)


def _parts(shape: tuple[int, ...], window: Window) -> list[tuple[slice, int, slice]]:
    """Output channels, group and window columns of each block."""
    rows = shape[0] // window.groups
    width = int(np.prod(shape[1:]))
    cuts = [slice(at, min(at + MOST_INPUTS, width)) for at in range(0, width, MOST_INPUTS)]
    return [
        (slice(group * rows, (group + 1) * rows), group, columns) for group in range(window.groups) for columns in cuts
    ]


def _moment_bytes(parts: Sequence[tuple[slice, int, slice]]) -> int:
    return sum((columns.stop - columns.start) ** 2 * np.dtype(np.float32).itemsize for _, _, columns in parts)


def window_of(node: onnx.NodeProto, weight_shape: tuple[int, ...]) -> Window:
    height, width = weight_shape[2:]
    pads = attribute(node, "pads", [0, 0, 0, 0])
    return Window(
        (int(height), int(width)),
        tuple(attribute(node, "strides", [1, 1])),
        tuple(attribute(node, "dilations", [1, 1])),
        tuple(pads),
        int(attribute(node, "group", 1)),
    )
