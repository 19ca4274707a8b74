"""Summary numbers of KITTI-style labels: what the simulated world is laid out by and measured against.

`summarise` turns many frames of labels into histograms; `data/train_statistics.json` holds those of KITTI's 3,712
train-side label files (KITTI: Geiger, Lenz, Stiller, Urtasun; CC BY-NC-SA 3.0) and no label itself. Made by
``python -m edge.simulation.label_statistics LABEL_DIR SPLIT_FILE OUT_JSON``.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.kitti import KITTI_CLASSES, parse_labels
from runtime.contracts.objects import Objects3D

CLASSES = ("Car", "Van", "Truck", "Pedestrian", "Cyclist")
UNKNOWN_OCCLUSION = 3
DEPTH_STEP_M = 5.0
LATERAL_STEP_M = 1.5
TRUNCATION_EDGES = (0.0, 1e-6, 0.15, 0.3, 0.5, 1.01)
CROWD_EDGES = (0, 3, 5, 9, 13, 99)  # objects a frame: 1-2, 3-4, 5-8, 9-12, 13 and more
DEPTH_BAND_EDGES_M = (-10.0, 10.0, 20.0, 35.0, 50.0, 200.0)
HEADING_BINS = 16


@dataclass(frozen=True, slots=True)
class LabelTable:
    """Rows of many frames: frame index, class index into `CLASSES`, and the label's numbers."""

    frame: NDArray[np.int64]
    kind: NDArray[np.int64]
    truncation: NDArray[np.float64]
    occlusion: NDArray[np.int64]
    pixel_height: NDArray[np.float64]
    size_hwl: NDArray[np.float64]
    x_m: NDArray[np.float64]
    z_m: NDArray[np.float64]
    yaw_rad: NDArray[np.float64]
    frames: int


def tabulate(labels: Iterable[Objects3D]) -> LabelTable:
    """The labels of `CLASSES` as one table."""
    parts: list[list[NDArray[Any]]] = []
    frames = 0
    for frame, objects in enumerate(labels):
        frames += 1
        names = np.array([objects.class_names[index] for index in objects.class_id])
        keep = np.isin(names, CLASSES)
        kind = np.array([CLASSES.index(str(name)) for name in names[keep]], dtype=np.int64)
        box = objects.box_in_left_image[keep]
        centre = objects.center_in_camera[keep]
        parts.append(
            [np.full(len(kind), frame), kind, objects.truncation[keep], objects.occlusion[keep], box[:, 3] - box[:, 1],
             objects.size_hwl[keep], centre[:, 0], centre[:, 2], objects.yaw_rad[keep]]
        )  # fmt: skip
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return LabelTable(*columns, frames=frames)


def difficulty(table: LabelTable) -> NDArray[np.int64]:
    """KITTI's level of each row: 0 easy, 1 moderate, 2 hard, 3 none of them."""
    level = np.full(len(table.kind), 3)
    for index, (height, occlusion, truncation) in reversed(
        list(enumerate([(40, 0, 0.15), (25, 1, 0.3), (25, 2, 0.5)]))
    ):
        passes = (table.pixel_height >= height) & (table.occlusion <= occlusion) & (table.truncation <= truncation)
        level[passes] = index
    return level


def crowd_of(count: NDArray[np.int64] | int) -> NDArray[np.int64]:
    """Crowd bucket of a frame by its number of objects."""
    return np.clip(np.digitize(count, CROWD_EDGES) - 1, 0, len(CROWD_EDGES) - 2)


def _cells(columns: Sequence[NDArray[np.int64]]) -> list[list[int]]:
    counted = Counter(zip(*(column.tolist() for column in columns), strict=True))
    return [[*key, count] for key, count in sorted(counted.items())]


def summarise(table: LabelTable) -> dict[str, Any]:
    """Histograms as JSON-ready lists.

    Keys: ``frames``; ``counts``: [objects of each class.., frames]; per class ``size_mean`` and ``size_covariance``
    (h, w, l) and ``appearance``: [crowd, depth bin, occlusion, truncation bin, count] (unknown occlusion left out) and
    ``placement``: [depth band, lateral bin, heading bin, count].
    """
    per_frame = np.stack(
        [np.bincount(table.frame[table.kind == k], minlength=table.frames) for k in range(len(CLASSES))], 1
    )
    crowd = crowd_of(per_frame.sum(axis=1))[table.frame]
    depth = np.clip(table.z_m // DEPTH_STEP_M, 0, None).astype(np.int64)
    truncation = np.digitize(table.truncation, TRUNCATION_EDGES) - 1
    band = np.digitize(table.z_m, DEPTH_BAND_EDGES_M) - 1
    lateral = np.floor(table.x_m / LATERAL_STEP_M + 0.5).astype(np.int64)
    heading = (np.floor(table.yaw_rad / (2 * np.pi / HEADING_BINS) + 0.5).astype(np.int64)) % HEADING_BINS
    summary: dict[str, Any] = {
        "source": "KITTI object labels, 3,712 train-side files; CC BY-NC-SA 3.0, Geiger, Lenz, Stiller, Urtasun",
        "frames": table.frames,
        "counts": _cells([per_frame[:, k] for k in range(len(CLASSES))]),
        "classes": {},
    }
    for index, name in enumerate(CLASSES):
        rows = table.kind == index
        known = rows & (table.occlusion < UNKNOWN_OCCLUSION)
        sizes = table.size_hwl[rows]
        summary["classes"][name] = {
            "size_mean": np.round(sizes.mean(axis=0), 4).tolist(),
            "size_covariance": np.round(np.cov(sizes.T), 5).tolist(),
            "size_low": np.round(np.percentile(sizes, 1, axis=0), 3).tolist(),
            "size_high": np.round(np.percentile(sizes, 99, axis=0), 3).tolist(),
            "appearance": _cells([crowd[known], depth[known], table.occlusion[known], truncation[known]]),
            "placement": _cells([band[rows], lateral[rows], heading[rows]]),
        }
    return summary


def train_statistics() -> dict[str, Any]:
    """The summary of the train-side labels that lies in the tree."""
    text = resources.files("edge.simulation").joinpath("data/train_statistics.json").read_text(encoding="utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded


def read_label_folder(folder: Path, names: Iterable[str]) -> Iterable[Objects3D]:
    """The label files of the named frames."""
    for name in names:
        yield parse_labels((folder / f"{name}.txt").read_text(encoding="utf-8"), where=f"{name}.txt")


def main(arguments: Sequence[str]) -> None:
    """Write the summary of a label folder."""
    folder, split, out = (Path(argument) for argument in arguments)
    names = split.read_text(encoding="utf-8").split()
    summary = summarise(tabulate(read_label_folder(folder, names)))
    out.write_text(json.dumps(summary, separators=(",", ":")) + "\n", encoding="utf-8")


if __name__ == "__main__":
    assert set(CLASSES) <= set(KITTI_CLASSES)
    main(sys.argv[1:])
