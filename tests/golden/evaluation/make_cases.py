"""Packs recorded evaluator cases into one JSON file each; run it where the reference recordings are.

    python tests/golden/evaluation/make_cases.py REFERENCE_FOLDER

Provenance: synthetic label and result text (not KITTI's) and the AP that the official code of YOLOStereo3D
(visualDet3D, commit ad229f2e491cba2c48f9bb2c211fe672294e2398) gave for it, its rotated overlap replaced by
exact polygons.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

CASES = ("empty_detections", "handmade", "noise_small")
METRICS = {"bbox": "2d", "bev": "bev", "3d": "3d", "aos": "aos"}


def pack(case: Path) -> dict:
    """Text of all frames and the expected AP as ``class -> metric -> overlap -> R40 / R11``."""
    expected: dict = {}
    for name, sets in json.loads((case / "expected.json").read_text())["classes"].items():
        for overlaps in (sets["strict"], sets["loose"]):
            of_metric = dict(zip(("bbox", "bev", "3d"), overlaps["min_overlap_bbox_bev_3d"], strict=True))
            of_metric["aos"] = of_metric["bbox"]
            for theirs, ours in METRICS.items():
                if theirs in overlaps:
                    points = {key: overlaps[theirs][key] for key in ("R40", "R11")}
                    expected.setdefault(name, {}).setdefault(ours, {})[str(of_metric[theirs])] = points
    names = sorted(path.name for path in (case / "gt").glob("*.txt"))
    return {
        "expected": expected,
        "labels": [(case / "gt" / name).read_text() for name in names],
        "detections": [(case / "dt" / name).read_text() for name in names],
    }


if __name__ == "__main__":
    for case in CASES:
        packed = pack(Path(sys.argv[1]) / "eval" / case)
        (Path(__file__).parent / f"{case}.json").write_text(json.dumps(packed, indent=0) + "\n")
