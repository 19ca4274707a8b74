"""Histograms of the values that a layer puts out, with the range that its 8 bits cover."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edge.report.files import write_bytes

COLUMNS = 2
INCHES_WH = (5.5, 2.6)


@dataclass(frozen=True, slots=True)
class RangePlot:
    """One tensor.

    Attributes:
        title: layer, with its noise.
        counts: (bins,) values by bin.
        first_edge, bin_width: where the bins lie.
        low, high: the chosen range.
        minimum, maximum: the extremes seen.
    """

    title: str
    counts: NDArray[np.int64]
    first_edge: float
    bin_width: float
    low: float
    high: float
    minimum: float
    maximum: float

    @property
    def share_outside(self) -> float:
        """Share of the values beyond the range, 0 to 1; to one bin."""
        middle = self.first_edge + self.bin_width * (np.arange(len(self.counts)) + 0.5)
        outside = (middle < self.low) | (middle > self.high)
        return float(self.counts[outside].sum() / max(int(self.counts.sum()), 1))


def write_range_plots(path: Path, plots: Sequence[RangePlot]) -> None:
    """Draw the histograms, counts on a logarithmic axis, into one PNG.

    Raises:
        ImportError: matplotlib is missing.
        OutputError: the place cannot be written.
    """
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import NullLocator

    rows = -(-len(plots) // COLUMNS)
    figure, axes = plt.subplots(rows, COLUMNS, figsize=(COLUMNS * INCHES_WH[0], rows * INCHES_WH[1]), squeeze=False)
    # measured by hand: a layout engine draws everything three times over
    figure.subplots_adjust(
        left=0.05, right=0.98, bottom=0.08 / rows + 0.02, top=1 - 0.25 / rows, hspace=0.55, wspace=0.2
    )
    for axis in axes.flat[len(plots) :]:
        axis.set_axis_off()
    for axis, plot in zip(axes.flat, plots, strict=False):
        used = np.flatnonzero(plot.counts)
        first, last = (int(used[0]), int(used[-1]) + 1) if len(used) else (0, 1)
        step = max(1, (last - first) // 256)
        starts = np.arange(first, last, step)
        counts = np.add.reduceat(plot.counts, starts) if len(used) else np.zeros(1)
        edges = plot.first_edge + plot.bin_width * np.append(starts, starts[-1] + step)
        axis.stairs(counts, edges, fill=True, color="#7a9cc6")
        if len(used):
            axis.set_yscale("log")
            axis.yaxis.set_minor_locator(NullLocator())  # a logarithmic axis draws hundreds of ticks otherwise
        for place, label in ((plot.low, f"{plot.low:.3g}"), (plot.high, f"{plot.high:.3g}")):
            axis.axvline(place, color="#c0392b", linewidth=1.2)
            axis.annotate(label, (place, 1.0), xycoords=("data", "axes fraction"), fontsize=7, color="#c0392b")
        title = f"{plot.title}\n{100 * plot.share_outside:.4f} % outside the range"
        axis.set_title(title, fontsize=8, pad=10)
        axis.tick_params(labelsize=7)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=110)
    plt.close(figure)
    write_bytes(path, content.getvalue())
