"""A run's log as a picture."""

from __future__ import annotations

import csv
from pathlib import Path

PANELS = ("class_loss", "box_loss", "disparity_loss", "learning_rate")


def plot_log(log: Path, picture: Path) -> None:
    """Plot losses and learning rate over steps; thin lines are the log's rows, thick ones their running mean."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    with log.open(newline="") as stream:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(stream)]
    if not rows:
        return
    steps = [row["step"] for row in rows]
    figure, axes = plt.subplots(2, 2, figsize=(11, 6), constrained_layout=True)
    for axis, name in zip(axes.flat, PANELS, strict=True):
        values = [row[name] for row in rows]
        axis.plot(steps, values, linewidth=0.6, alpha=0.4)
        axis.plot(steps, _running_mean(values, 0.95), linewidth=1.6)
        axis.set_title(name.replace("_", " "))
        axis.set_xlabel("step")
        axis.grid(alpha=0.3)
        if name.endswith("_loss") and max(values) > 0:
            axis.set_yscale("log")
    figure.savefig(picture, dpi=110)
    plt.close(figure)


def _running_mean(values: list[float], keep: float) -> list[float]:
    means: list[float] = []
    for value in values:
        means.append(value if not means else keep * means[-1] + (1 - keep) * value)
    return means
