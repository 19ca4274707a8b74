"""Fixtures shared by all rooms' tests."""

from __future__ import annotations

import importlib.util
import shutil
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with reference recordings and real frames, beside the checkout; absent in a user's clone."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "reference").is_dir():
        pytest.skip("reference recordings and KITTI frames are not on this machine")
    return folder


@pytest.fixture(scope="session")
def reference_dir(shared_dir: Path) -> Path:
    """Recorded numbers of the official code."""
    return shared_dir / "reference"


@pytest.fixture(scope="session")
def golden_dir() -> Path:
    """Recorded numbers of the official code that are small enough to lie in the tree."""
    return REPOSITORY / "tests" / "golden" / "official"


@pytest.fixture(scope="session")
def golden_module() -> Callable[[str], ModuleType]:
    """Loads ``tests/golden/PATH``, a Python file that makes a recording's inputs."""

    def load(path: str) -> ModuleType:
        file = REPOSITORY / "tests" / "golden" / path
        spec = importlib.util.spec_from_file_location(file.stem, file)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture(scope="session")
def kitti_dir(shared_dir: Path) -> Path:
    """Real KITTI frames, labels, published detections."""
    folder = shared_dir / "kitti"
    if not folder.is_dir():
        pytest.skip("KITTI frames are not on this machine")
    return folder


# A model and a drive that are small, exact and quick to make, for whatever runs a whole model directory. The network
# image is 64 x 32 and half the size of the camera's. One anchor answers: its score grows with the brightness of the
# left view (black: nothing, from grey 100 up: a car), its depth is 20 m + 10 m x the brightness of the right view, so
# that boxes tell which two views were looked at together.
TINY_CAMERA_WH = (128, 64)
TINY_FOCAL_PX, TINY_BASELINE_M = 200.0, 0.5
TINY_ANCHOR = (1 * 4 + 2) * 48 + 20  # second row, third column: below the horizon, straight ahead


def tiny_depth_m(right_brightness: int) -> float:
    """What the tiny model makes of a right view of one grey value."""
    return 20.0 + 10.0 * right_brightness / 255.0


@pytest.fixture(scope="session")
def tiny_model_master(tmp_path_factory: pytest.TempPathFactory) -> Path:
    onnx = pytest.importorskip("onnx")
    from onnx import TensorProto, helper, numpy_helper

    from runtime.contracts import manifest as contract

    anchors = contract.AnchorLayout()
    count = 2 * 4 * anchors.per_cell
    cls_base, cls_gain = np.full((1, count, 4), -6.0, np.float32), np.zeros((1, count, 4), np.float32)
    cls_gain[0, TINY_ANCHOR, 0] = 16.0
    delta_gain = np.zeros((1, count, 12), np.float32)
    delta_gain[0, TINY_ANCHOR, 6] = 1.0
    tensors = {"cls_base": cls_base, "cls_gain": cls_gain, "delta_gain": delta_gain, "white": np.float32(255.0)}
    nodes = []
    for view in ("left", "right"):
        nodes += [
            helper.make_node("Cast", [view], [f"{view}_float"], to=TensorProto.FLOAT),
            helper.make_node("ReduceMean", [f"{view}_float"], [f"{view}_mean"], keepdims=0),
            helper.make_node("Div", [f"{view}_mean", "white"], [f"{view}_brightness"]),
        ]
    nodes += [
        helper.make_node("Mul", ["cls_gain", "left_brightness"], ["cls_rise"]),
        helper.make_node("Add", ["cls_base", "cls_rise"], ["cls_logits"]),
        helper.make_node("Mul", ["delta_gain", "right_brightness"], ["box_deltas"]),
    ]
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, TensorProto.UINT8, [1, 3, 32, 64]) for name in ("left", "right")],
        [
            helper.make_tensor_value_info("cls_logits", TensorProto.FLOAT, [1, count, 4]),
            helper.make_tensor_value_info("box_deltas", TensorProto.FLOAT, [1, count, 12]),
        ],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in tensors.items()],
    )
    folder = tmp_path_factory.mktemp("tiny") / "tiny-model"
    folder.mkdir()
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    onnx.save(model, folder / contract.MODEL_FILE)
    classes = ("Car", "Pedestrian", "Cyclist")
    shape = (3, anchors.scale_count, len(anchors.ratios), 6)
    mean = np.broadcast_to(np.array([20.0, 0.0, 1.0, 1.6, 1.5, 3.9], np.float32), shape)
    std = np.broadcast_to(np.array([10.0, 1.0, 1.0, 0.1, 0.1, 0.3], np.float32), shape)
    contract.write_priors(folder / contract.PRIORS_FILE, classes, contract.AnchorPriors(mean, std))
    manifest = contract.Manifest(
        preset="tiny",
        classes=classes,
        input_size_hw=(32, 64),
        input_type="uint8",
        views=2,
        crop=contract.Crop("top_rows", 0),
        normalisation=contract.Normalisation(),
        anchors=anchors,
        nms=contract.NmsPolicy(),
        thresholds=contract.Thresholds(),
        rig=contract.RigLimits(TINY_FOCAL_PX / 2, TINY_BASELINE_M),
        sha256={name: contract.file_sha256(folder / name) for name in (contract.MODEL_FILE, contract.PRIORS_FILE)},
    )
    (folder / contract.MANIFEST_FILE).write_text(contract.format_manifest(manifest), encoding="utf-8")
    return folder


@pytest.fixture
def tiny_model(tiny_model_master: Path, tmp_path: Path) -> Path:
    """A model directory of one's own, to run or to damage."""
    return Path(shutil.copytree(tiny_model_master, tmp_path / "tiny-model"))


@pytest.fixture
def tiny_drive(tmp_path: Path) -> Path:
    """Four labelled pairs in KITTI object layout; frame n has a left view of grey 200 and a right one of grey 40 n."""
    cv2 = pytest.importorskip("cv2")
    from runtime.contracts.geometry import StereoGeometry
    from runtime.contracts.kitti import format_calib

    width, height = TINY_CAMERA_WH
    left = np.array([[TINY_FOCAL_PX, 0, width / 2, 0], [0, TINY_FOCAL_PX, height / 2, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -TINY_FOCAL_PX * TINY_BASELINE_M
    calibration = format_calib(StereoGeometry(left, right, TINY_CAMERA_WH))
    root = tmp_path / "tiny-drive"
    for name in ("image_2", "image_3", "calib", "label_2"):
        (root / "training" / name).mkdir(parents=True)
    (root / "ImageSets").mkdir()
    stems = [f"{number:06d}" for number in range(4)]
    for number, stem in enumerate(stems):
        for folder, grey in (("image_2", 200), ("image_3", 40 * number)):
            image = np.full((height, width, 3), grey, np.uint8)
            assert cv2.imwrite(str(root / "training" / folder / f"{stem}.png"), image)
        (root / "training" / "calib" / f"{stem}.txt").write_text(calibration, encoding="utf-8")
        label = "Car 0.00 0 0.10 60 26 80 54 1.50 1.60 3.90 0.50 1.60 20.00 0.12\n"
        (root / "training" / "label_2" / f"{stem}.txt").write_text(label, encoding="utf-8")
    (root / "ImageSets" / "val.txt").write_text("\n".join(stems[2:]) + "\n", encoding="utf-8")
    return root
