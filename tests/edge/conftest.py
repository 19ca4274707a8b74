"""A toy recording and toy models whose boxes are known: enough for commands that run models over sources."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_calib, format_labels
from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    AnchorLayout,
    AnchorPriors,
    Crop,
    Manifest,
    NmsPolicy,
    Normalisation,
    RigLimits,
    Thresholds,
    file_sha256,
    format_manifest,
    write_priors,
)
from runtime.contracts.objects import Objects3D
from runtime.detector import open_detector
from runtime.sources.factory import open_sequence

SIZE_WH = (128, 64)
FOCAL_PX, BASELINE_M = 100.0, 0.54
FRAMES = 6
CLASSES = ("Car", "Pedestrian")
ANCHORS = AnchorLayout()
ROW, COLUMNS = 2, (1, 4, 7)  # cells whose anchors pass the ground-plane test and do not overlap
SHAPE = 1 * ANCHORS.scale_count + 4  # ratio 1, 48 pixels
Z_DELTA = 6


@pytest.fixture(scope="session")
def toy_model(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Makes model directories that find cars at given scores: ``toy_model(name, scores=(..), shift_m=0.0)``.

    One score a column, 0 for no car; ``shift_m`` moves all cars away. Whatever the image shows, the boxes are the same.
    """
    pytest.importorskip("onnx", reason="toy models are written with onnx")

    def make(name: str, *, scores: tuple[float, float, float] = (0.9, 0.8, 0.7), shift_m: float = 0.0) -> Path:
        folder = tmp_path_factory.mktemp("models") / name
        folder.mkdir()
        _write_graph(folder / MODEL_FILE, scores, shift_m)
        shape = (len(CLASSES), ANCHORS.scale_count, len(ANCHORS.ratios), 6)
        mean = np.broadcast_to(np.array([20.0, 0.0, 1.0, 1.6, 1.5, 3.9], np.float32), shape)
        std = np.broadcast_to(np.array([1.0, 0.1, 0.1, 0.1, 0.1, 0.1], np.float32), shape)
        write_priors(folder / PRIORS_FILE, CLASSES, AnchorPriors(mean.copy(), std.copy()))
        manifest = Manifest(
            preset="toy", classes=CLASSES, input_size_hw=SIZE_WH[::-1], input_type="uint8", views=2,
            crop=Crop("top_rows", 0), normalisation=Normalisation(), anchors=ANCHORS, nms=NmsPolicy(),
            thresholds=Thresholds(evaluate=0.05, display=0.5), rig=RigLimits(FOCAL_PX, BASELINE_M),
            sha256={item: file_sha256(folder / item) for item in (MODEL_FILE, PRIORS_FILE)},
        )  # fmt: skip
        (folder / MANIFEST_FILE).write_text(format_manifest(manifest))
        return folder

    return make


def _write_graph(path: Path, scores: tuple[float, ...], shift_m: float) -> None:
    from onnx import TensorProto, helper, numpy_helper, save_model

    rows, columns = SIZE_WH[1] // ANCHORS.stride_px, SIZE_WH[0] // ANCHORS.stride_px
    cls_logits = np.full((rows, columns, ANCHORS.per_cell, len(CLASSES) + 1), -20.0, np.float32)
    cls_logits[..., -1] = 20.0
    for column, score in zip(COLUMNS, scores, strict=True):
        if score > 0:
            cls_logits[ROW, column, SHAPE, 0] = np.log(score / (1.0 - score))
    box_deltas = np.zeros((rows, columns, ANCHORS.per_cell, 12), np.float32)
    box_deltas[..., Z_DELTA] = shift_m  # in units of the prior's deviation, 1 m
    constants = {
        "cls_constant": cls_logits.reshape(1, -1, len(CLASSES) + 1),
        "box_constant": box_deltas.reshape(1, -1, 12),
    }
    nodes = [helper.make_node("Cast", [side], [f"{side}_f"], to=TensorProto.FLOAT) for side in ("left", "right")]
    nodes += [helper.make_node("ReduceMean", [f"{side}_f"], [f"{side}_m"], keepdims=0) for side in ("left", "right")]
    nodes += [
        helper.make_node("Add", ["left_m", "right_m"], ["sum"]),
        helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
        helper.make_node("Add", ["cls_constant", "nothing"], ["cls_logits"]),
        helper.make_node("Add", ["box_constant", "nothing"], ["box_deltas"]),
    ]
    image = [1, 3, SIZE_WH[1], SIZE_WH[0]]
    graph = helper.make_graph(
        nodes,
        "toy",
        [helper.make_tensor_value_info(side, TensorProto.UINT8, image) for side in ("left", "right")],
        [
            helper.make_tensor_value_info("cls_logits", TensorProto.FLOAT, constants["cls_constant"].shape),
            helper.make_tensor_value_info("box_deltas", TensorProto.FLOAT, constants["box_constant"].shape),
        ],
        [numpy_helper.from_array(value, name) for name, value in constants.items()]
        + [numpy_helper.from_array(np.float32(0.0), "zero")],
    )
    save_model(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))


@pytest.fixture(scope="session")
def toy_recording(tmp_path_factory: pytest.TempPathFactory, toy_model: Callable[..., Path]) -> Path:
    """A KITTI object folder of six pairs; what the default toy model finds is what the labels say."""
    root = tmp_path_factory.mktemp("recording")
    generator = np.random.default_rng(7)
    names = [f"{index:06d}" for index in range(FRAMES)]
    projection = np.array([[FOCAL_PX, 0, 64, 0], [0, FOCAL_PX, 32, 0], [0, 0, 1, 0]])
    right = projection.copy()
    right[0, 3] = -FOCAL_PX * BASELINE_M
    for folder in ("image_2", "image_3", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    (root / "ImageSets").mkdir()
    (root / "ImageSets" / "val.txt").write_text("\n".join(names) + "\n")
    for name in names:
        for folder in ("image_2", "image_3"):
            pixels = generator.integers(0, 255, (SIZE_WH[1], SIZE_WH[0], 3), dtype=np.uint8)
            cv2.imwrite(str(root / "training" / folder / f"{name}.png"), pixels)
        calibration = format_calib(StereoGeometry(projection, right, SIZE_WH))
        (root / "training" / "calib" / f"{name}.txt").write_text(calibration)
    with open_sequence(f"kitti-object:{root}?split=val") as frames, open_detector(toy_model("truth")) as detector:
        found, _ = detector(frames[0])
    assert len(found) == len(COLUMNS)
    count = len(found)
    truth = Objects3D(
        class_id=found.class_id,
        box_in_left_image=found.box_in_left_image,
        center_in_camera=found.center_in_camera,
        size_hwl=found.size_hwl,
        alpha_rad=found.alpha_rad,
        yaw_rad=found.yaw_rad,
        truncation=np.zeros(count),
        occlusion=np.zeros(count, dtype=np.int64),
        track_id=np.full(count, -1),
        dont_care_boxes=np.zeros((0, 4)),
        class_names=found.class_names,
    )
    for index, name in enumerate(names):
        # one object fewer in every other frame, so that frames differ
        shown = truth if index % 2 else truth.select(np.arange(count - 1))
        (root / "training" / "label_2" / f"{name}.txt").write_text(format_labels(shown))
    return root
