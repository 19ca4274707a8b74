"""What passes through a tensor, kept as a histogram that grows with the values and never as the values.

A `StreamingHistogram` has a fixed number of bins. When a value falls outside, neighbouring bins are merged
in pairs, which doubles the width of all of them, until the value fits; so at least half of the bins always
lie within the values seen, the memory stays the same for one frame and for a thousand, and one pass over
the frames is enough for every method of `calib.methods`. Extremes are kept exactly beside it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FormatError

BINS = 4096
_EXACT_FLOAT32_COUNT = 1 << 24  # OpenCV counts in float32
_NOTHING = "calibration: found no values at all; expected one frame or more; give a source with frames"
_SMALLEST_SPAN = 1e-12
_SMALLEST_RELATIVE_SPAN = 1e-3  # float32 edges stay apart even where all values are nearly equal


@dataclass(frozen=True, slots=True)
class TensorStatistics:
    """One tensor over all calibration frames.

    Attributes:
        minimum, maximum: exact extremes.
        counts: (bins,) int64, values by bin.
        first_edge: lower edge of the first bin.
        bin_width: width of each bin, in the tensor's own unit.
    """

    minimum: float
    maximum: float
    counts: NDArray[np.int64]
    first_edge: float
    bin_width: float

    @property
    def centers(self) -> NDArray[np.float64]:
        """(bins,) middle of each bin."""
        steps = np.arange(len(self.counts), dtype=np.float64) + 0.5
        return np.asarray(self.first_edge + self.bin_width * steps, np.float64)


class StreamingHistogram:
    """Collects `TensorStatistics` array by array."""

    def __init__(self, bins: int = BINS) -> None:
        """Takes an even number of bins."""
        if bins < 2 or bins % 2:
            raise FormatError(f"histogram bins: found {bins}; expected an even number, 2 or more; use {BINS}")
        self._counts = np.zeros(bins, np.int64)
        self._first_edge = 0.0
        self._bin_width = 0.0
        self._minimum, self._maximum = np.inf, -np.inf

    def update(self, values: NDArray[np.float32], *, name: str = "tensor") -> None:
        """Adds all values of an array of any shape.

        Raises:
            FormatError: a value is not finite.
        """
        if values.size == 0:
            return
        flat = np.ascontiguousarray(values, np.float32).reshape(-1)
        low, high = float(flat.min()), float(flat.max())
        if not (np.isfinite(low) and np.isfinite(high)):
            raise FormatError(
                f"{name}: found a value that is not finite in the float model; expected numbers; "
                "check the weights before quantising"
            )
        self._minimum, self._maximum = min(self._minimum, low), max(self._maximum, high)
        self._cover(low, high)
        for start in range(0, flat.size, _EXACT_FLOAT32_COUNT):
            self._count(flat[start : start + _EXACT_FLOAT32_COUNT])

    def statistics(self) -> TensorStatistics:
        """What was collected so far.

        Raises:
            FormatError: nothing was.
        """
        if self._minimum > self._maximum:
            raise FormatError(_NOTHING)
        return TensorStatistics(self._minimum, self._maximum, self._counts.copy(), self._first_edge, self._bin_width)

    def _cover(self, low: float, high: float) -> None:
        bins = len(self._counts)
        if self._bin_width == 0.0:
            span = max(high - low, abs(low) * _SMALLEST_RELATIVE_SPAN, _SMALLEST_SPAN)
            self._bin_width = span * (1 + 1e-6) / bins
            self._first_edge = low
        while True:  # both ends again after each step: a large step swallows a small end by rounding
            if high >= self._first_edge + bins * self._bin_width:
                self._merge(at_start=True)
            elif low < self._first_edge:
                self._first_edge -= bins * self._bin_width
                self._merge(at_start=False)
            else:
                return

    def _merge(self, *, at_start: bool) -> None:
        """Halves the bins in use; the freed half opens above them, or (not at_start) below them."""
        half = len(self._counts) // 2
        merged = self._counts.reshape(half, 2).sum(axis=1)
        self._counts[:] = 0
        self._counts[:half] = merged if at_start else 0
        if not at_start:
            self._counts[half:] = merged
        self._bin_width *= 2

    def _count(self, flat: NDArray[np.float32]) -> None:
        bins = len(self._counts)
        last_edge = self._first_edge + bins * self._bin_width
        # OpenCV takes the edges in float32: one step outwards, so that no value at an end is lost to
        # rounding.
        edges = [
            float(np.nextafter(np.float32(self._first_edge), np.float32(-np.inf))),
            float(np.nextafter(np.float32(last_edge), np.float32(np.inf))),
        ]
        found = cv2.calcHist([flat.reshape(1, -1)], [0], None, [bins], edges)
        self._counts += found.reshape(-1).astype(np.int64)


class ChannelExtremes:
    """Exact minimum and maximum of each channel (axis 1) over all frames."""

    def __init__(self) -> None:
        """Starts empty."""
        self._low: NDArray[np.float32] | None = None
        self._high: NDArray[np.float32] | None = None

    def update(self, values: NDArray[np.float32]) -> None:
        """Adds an array (B, C, ...)."""
        axes = tuple(axis for axis in range(values.ndim) if axis != 1)
        low, high = values.min(axis=axes), values.max(axis=axes)
        self._low = low if self._low is None else np.minimum(self._low, low)
        self._high = high if self._high is None else np.maximum(self._high, high)

    def extremes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(C,) minima and (C,) maxima.

        Raises:
            FormatError: nothing was collected.
        """
        if self._low is None or self._high is None:
            raise FormatError(_NOTHING)
        return self._low, self._high
