"""docs/your-camera.md: its Python runs as it is written, from OpenCV's calibration to boxes."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest

from edge.samples import measuring_source
from runtime.rig import load_geometry
from runtime.sources.base import as_sequence
from runtime.sources.factory import open_source

PAGE = Path(__file__).parents[2] / "docs" / "your-camera.md"
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)


def test_the_rig_is_what_opencv_calibrated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    w, h, focal_px, baseline_m = 640, 480, 400.0, 0.12
    camera = np.array([[focal_px, 0, 320], [0, focal_px, 240], [0, 0, 1]])
    board = np.stack([*np.meshgrid(np.arange(9) * 0.03, np.arange(6) * 0.03), np.zeros((6, 9))], -1).reshape(-1, 3)
    poses = [(np.array([a, b, 0.1]), np.array([-0.1, -0.1, 0.5 + a])) for a in (0.2, -0.3) for b in (0.3, -0.2)]
    views = []
    for turn, place in poses:
        shifted = place - [baseline_m, 0, 0]
        views.append([cv2.projectPoints(board, turn, spot, camera, None)[0] for spot in (place, shifted)])
    names = {
        "cv2": cv2, "json": json, "Path": Path, "w": w, "h": h, "K1": camera.copy(), "K2": camera.copy(),
        "D1": np.zeros(5), "D2": np.zeros(5), "board_points": [board.astype(np.float32)] * len(views),
        "left_points": [view[0].astype(np.float32) for view in views],
        "right_points": [view[1].astype(np.float32) for view in views],
    }  # fmt: skip
    for block in BLOCKS[:2]:
        exec(block, names)
    geometry = load_geometry("rig.json", (w, h))
    assert geometry.baseline_m == pytest.approx(baseline_m, rel=1e-3)
    assert geometry.focal_px == pytest.approx(focal_px, rel=0.05)
    assert names["left_map"][0].shape[:2] == (h, w)


def test_frames_become_boxes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with as_sequence(open_source(measuring_source())) as source:
        frames = [source[index] for index in (0, 1)]
    height, width = frames[0].left.shape[:2]
    geometry = frames[0].geometry
    rig = {"schema": 1, "image_size_wh": [width, height], "P2": geometry.P2.tolist(), "P3": geometry.P3.tolist()}
    (tmp_path / "rig.json").write_text(json.dumps(rig))
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    names = {
        "w": width, "h": height, "left_map": (x, y), "right_map": (x, y),
        "camera": [(frame.left, frame.right, frame.timestamp_secs) for frame in frames],
    }  # fmt: skip
    (code,) = [block for block in BLOCKS if "open_detector" in block]
    model = str(files("edge.zoo") / "compact-int8")
    exec(code.replace('"rig.json"', repr(str(tmp_path / "rig.json"))).replace('"my-int8"', repr(model)), names)
    lines = capsys.readouterr().out.splitlines()
    assert lines and all(re.search(r"\w+ [01]\.\d\d at \d+\.\d m, [+-]\d+\.\d m to the right", line) for line in lines)
