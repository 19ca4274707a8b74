"""Writes the small slices of the recorded network cases: ``python make_slices.py REFERENCE_FOLDER``.

The recordings are of the official code (github Owen-Liuyuxuan/visualDet3D, commit ad229f2) on a CPU in float32, with
weights case 0 and image seed 1000 of ``recorded_case.py``. What is kept: every n-th value of each tensor, the whole
detections, and the bounds (each tensor's float32-to-float64 difference).
"""

from __future__ import annotations

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
VALUES_KEPT = {"cls_out": 1500, "reg_out": 3000}
VALUES_KEPT_OTHERWISE = 240


def main(reference: Path) -> None:
    for case in ("net_96x320", "net_288x1280"):
        facts = json.loads((reference / f"{case}.json").read_text())
        arrays: dict[str, np.ndarray] = {}
        tensors: dict[str, dict[str, object]] = {}
        with np.load(reference / f"{case}.npz") as recorded:
            for name in recorded.files:
                values = recorded[name]
                entry = facts["tensors"].get(name)
                if entry is None:  # detections
                    arrays[name] = values
                    continue
                step = max(1, values.size // VALUES_KEPT.get(name, VALUES_KEPT_OTHERWISE)) | 1  # odd: all channels
                arrays[name] = values.ravel()[::step]
                tensors[name] = {
                    "rounding": entry["max_abs_diff_fp32_vs_fp64"],
                    "largest": float(np.abs(values.astype(np.float64)).max()),
                    "half": values.dtype == np.float16,
                    "slices": [int(number) for number in re.findall(r"::(\d+)", entry["stored"])],
                    "step": step,
                }
        np.savez_compressed(HERE / f"{case}.npz", **arrays)
        kept = {"P2": facts["P2"], "P3": facts["P3"], "tensors": tensors}
        (HERE / f"{case}.json").write_text(json.dumps(kept, indent=1) + "\n")
    shutil.copyfile(reference / "macs_params.json", HERE / "macs_params.json")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
