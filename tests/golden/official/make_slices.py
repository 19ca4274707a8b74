"""Cuts the larger recordings to what the tests read; run it where all recordings are.

python tests/golden/official/make_slices.py REFERENCE_FOLDER
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
PICTURE_ROWS = 4
"""Of the photometric pictures: colour changes treat every pixel alike."""


def cut_pipeline(reference: Path) -> None:
    """Cameras, boxes, block matching, colours; and resized pixels, every fourth row, in a file for each size."""
    with np.load(reference / "data_pipeline.npz") as recorded:
        kept = {name: recorded[name] for name in recorded.files if name.endswith(("_P2", "_P3"))}
        kept |= {name: recorded[name] for name in recorded.files if name.startswith("proj_")}
        kept |= {name: recorded[name][:PICTURE_ROWS] for name in recorded.files if name.startswith("photo_")}
        kept |= {name: recorded[name] for name in ("bm_disp16", "bm_reduced_left")}
        for size in ("80x150", "80x110"):
            resized = {
                "rgb": recorded[f"presmall_{size}_left_in"],
                "every_4th_row": recorded[f"presmall_{size}_left"][::4],
                "P2": recorded[f"presmall_{size}_P2"],
            }
            np.savez_compressed(HERE / f"resized_{size}.npz", **resized)
    np.savez_compressed(HERE / "data_pipeline.npz", **kept)


def cut_disparity_loss(reference: Path) -> None:
    """Inputs and values in full, gradients of every eighth class."""
    with np.load(reference / "loss_disparity.npz") as recorded:
        names = ("logits", "gt", "loss", "loss_focal_coefficient_1", "loss_focal_coefficient_5")
        kept = {name: recorded[name] for name in names}
        kept["grad_every_8th"] = recorded["grad"][:, ::8]
    np.savez_compressed(HERE / "loss_disparity.npz", **kept)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    cut_pipeline(folder)
    cut_disparity_loss(folder)
    climbs = json.loads((folder / "mono.json").read_text())["hill_climb"]
    (HERE / "hill_climb.json").write_text(json.dumps(climbs, indent=0) + "\n")
