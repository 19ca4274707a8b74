"""``log.csv``: means of losses over some steps, a line each."""

from __future__ import annotations

import csv
import time
from pathlib import Path

LOG_FILE = "log.csv"
LOG_COLUMNS = (
    "step",
    "learning_rate",
    "class_loss",
    "box_loss",
    "disparity_loss",
    "gradient_norm",
    "samples_per_sec",
)


class RunLog:
    """Collects steps, writes means.

    Args:
        path: the CSV file; lines of steps after ``first_step``, left by an interrupted run, are taken out.
        first_step: where this part of the run begins.
        every: steps a line.
        batch_size: samples a step.
    """

    def __init__(self, path: Path, *, first_step: int, every: int, batch_size: int) -> None:
        self._path = path
        self._every = every
        self._batch_size = batch_size
        self._sums: dict[str, float] = {}
        self._count = 0
        self._since = time.monotonic()
        rows = _rows_until(path, first_step) if path.exists() else []
        with path.open("w", newline="") as stream:
            csv.writer(stream).writerows([LOG_COLUMNS, *rows])

    def add(self, step: int, rate: float, losses: dict[str, float], *, last: bool = False) -> dict[str, float] | None:
        """Take in a step; the line that was written, if this step completes one or is the run's last."""
        self._count += 1
        for name, value in losses.items():
            self._sums[name] = self._sums.get(name, 0.0) + value
        if step % self._every and not last:
            return None
        now = time.monotonic()
        means = {name: value / self._count for name, value in self._sums.items()}
        row = {
            "step": step,
            "learning_rate": rate,
            "samples_per_sec": self._batch_size * self._count / (now - self._since),
            **means,
        }
        with self._path.open("a", newline="") as stream:
            csv.writer(stream).writerow([f"{row[column]:.6g}" for column in LOG_COLUMNS])
        self._sums, self._count, self._since = {}, 0, now
        return row

    def pause(self, secs: float) -> None:
        """Leave time that went elsewhere out of the rate."""
        self._since += secs


def _rows_until(path: Path, last_step: int) -> list[list[str]]:
    with path.open(newline="") as stream:
        return [row for row in list(csv.reader(stream))[1:] if row and float(row[0]) <= last_step]
