"""A stereo network in small, with every pattern of the real ones, as a graph and as a model directory."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

NETWORK_HW = (32, 64)
DISPARITIES = 6
SHIFTS = 3
CELLS_HW = (2, 4)
ANCHORS = 48
HEAD_GAIN = np.float32(0.1)  # deltas of the size of a trained network's


class ToyWriter:
    """Collects nodes and seeded weights."""

    def __init__(self) -> None:
        self.random = np.random.default_rng(7)
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, np.ndarray] = {}

    def node(self, kind: str, inputs: list[str], output: str, **attributes: object) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [output], name=output, **attributes))
        return output

    def constant(self, name: str, value: np.ndarray) -> str:
        self.constants[name] = value
        return name

    def conv(self, source: str, name: str, shape: tuple[int, ...], **attributes: object) -> str:
        fan_in = int(np.prod(shape[1:]))
        weight = self.random.normal(0, np.sqrt(2 / fan_in), shape).astype(np.float32)
        weight *= self.random.uniform(0.3, 3, (shape[0], *[1] * (len(shape) - 1))).astype(np.float32)
        bias = self.random.normal(0, 0.2, shape[0]).astype(np.float32)
        inputs = [source, self.constant(f"{name}.weight", weight), self.constant(f"{name}.bias", bias)]
        return self.node("Conv", inputs, name, **attributes)

    def relu(self, source: str) -> str:
        return self.node("Relu", [source], f"{source}/relu")

    def slices(self, source: str, name: str, bounds: tuple[int, int], axis: int) -> str:
        parts = [
            self.constant(f"{name}.{part}", np.array([value], np.int64))
            for part, value in (("start", bounds[0]), ("end", bounds[1]), ("axis", axis))
        ]
        return self.node("Slice", [source, *parts], name)


def make_toy_model() -> onnx.ModelProto:
    """Normalisation, stem, pool, residual block, correlation, ghost, concatenation volume, two heads."""
    from export.function_body import stereo_correlation_function
    from runtime.contracts.correlation import DOMAIN, MAX_DISPARITY, STEREO_CORRELATION, VERSION

    write = ToyWriter()
    mean, std = np.array([0.485, 0.456, 0.406]), np.array([0.229, 0.224, 0.225])
    write.constant("gain", (1 / (255 * std)).reshape(1, 3, 1, 1).astype(np.float32))
    write.constant("offset", (-mean / std).reshape(1, 3, 1, 1).astype(np.float32))
    for view in ("left", "right"):
        write.node("Cast", [view], f"{view}/float", to=TensorProto.FLOAT)
        write.node("Mul", [f"{view}/float", "gain"], f"{view}/scaled")
        write.node("Add", [f"{view}/scaled", "offset"], f"{view}/normal")
    both = write.node("Concat", ["left/normal", "right/normal"], "both", axis=0)
    stem = write.relu(write.conv(both, "stem", (8, 3, 7, 7), strides=[2, 2], pads=[3, 3, 3, 3]))
    pooled = write.node(
        "MaxPool", [stem], "pool", kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1]
    )  # 8 channels at 8 x 16
    inner = write.relu(write.conv(pooled, "block.conv1", (8, 8, 3, 3), pads=[1, 1, 1, 1]))
    outer = write.conv(inner, "block.conv2", (8, 8, 3, 3), pads=[1, 1, 1, 1])
    fine = write.relu(write.node("Add", [outer, pooled], "block.add"))
    left, right = (write.slices(fine, f"fine.{i}", (i, i + 1), 0) for i in (0, 1))
    volume = "volume"
    write.nodes.append(
        helper.make_node(
            STEREO_CORRELATION, [left, right], [volume], name=volume, domain=DOMAIN, **{MAX_DISPARITY: DISPARITIES}
        )
    )
    primary = write.relu(write.conv(volume, "ghost.primary", (6, DISPARITIES, 3, 3), pads=[1, 1, 1, 1]))
    cheap = write.relu(write.conv(primary, "ghost.cheap", (6, 1, 3, 3), pads=[1, 1, 1, 1], group=6))
    ghost = write.node("Concat", [volume, primary, cheap], "ghost", axis=1)  # 18 channels
    halved = write.node("AveragePool", [ghost], "ghost.pool", kernel_shape=[2, 2], strides=[2, 2])  # 4 x 8
    stereo = write.relu(write.conv(halved, "stereo", (12, 18, 3, 3), strides=[2, 2], pads=[1, 1, 1, 1]))  # 2 x 4

    coarse = write.relu(write.conv(fine, "coarse", (8, 8, 3, 3), strides=[4, 4], pads=[1, 1, 1, 1]))  # 2 x 4
    reduced = write.relu(write.conv(coarse, "reduce", (4, 8, 1, 1)))
    views = [write.slices(reduced, f"reduced.{i}", (i, i + 1), 0) for i in (0, 1)]
    planes = []
    for shift in range(SHIFTS):
        a = write.slices(views[0], f"shift{shift}.left", (shift, CELLS_HW[1]), 3)
        b = write.slices(views[1], f"shift{shift}.right", (0, CELLS_HW[1] - shift), 3)
        pair = write.node("Concat", [a, b], f"shift{shift}.pair", axis=1)
        pads = write.constant(f"shift{shift}.pads", np.array([0, 0, 0, shift, 0, 0, 0, 0], np.int64))
        padded = write.node("Pad", [pair, pads], f"shift{shift}.padded")
        depth_axis = write.constant(f"shift{shift}.depth_axis", np.array([2], np.int64))
        planes.append(write.node("Unsqueeze", [padded, depth_axis], f"shift{shift}.plane"))
    stacked = write.node("Concat", planes, "stacked", axis=2)
    mixed = write.relu(write.conv(stacked, "mix", (4, 8, 3, 3, 3), pads=[1] * 6))
    flat_shape = write.constant("flat_shape", np.array([1, 4 * SHIFTS, *CELLS_HW], np.int64))
    flat = write.node("Reshape", [mixed, flat_shape], "flat")
    features = write.node("Concat", [stereo, flat], "features", axis=1)  # 24 channels
    for output, columns in (("cls_logits", 4), ("box_deltas", 12)):
        hidden = write.relu(write.conv(features, f"{output}.hidden", (16, 24, 3, 3), pads=[1, 1, 1, 1]))
        last = write.conv(hidden, f"{output}.last", (ANCHORS * columns, 16, 3, 3), pads=[1, 1, 1, 1])
        for part in ("weight", "bias"):
            write.constants[f"{output}.last.{part}"] *= HEAD_GAIN
        turned = write.node("Transpose", [last], f"{output}.turned", perm=[0, 2, 3, 1])
        shape = write.constant(f"{output}.shape", np.array([1, -1, columns], np.int64))
        write.node("Reshape", [turned, shape], output)
    count = CELLS_HW[0] * CELLS_HW[1] * ANCHORS
    graph = helper.make_graph(
        write.nodes,
        "toy",
        [helper.make_tensor_value_info(name, TensorProto.UINT8, [1, 3, *NETWORK_HW]) for name in ("left", "right")],
        [
            helper.make_tensor_value_info(name, TensorProto.FLOAT, [1, count, columns])
            for name, columns in (("cls_logits", 4), ("box_deltas", 12))
        ],
        [numpy_helper.from_array(value, name) for name, value in write.constants.items()],
    )
    opsets = [helper.make_opsetid("", 18), helper.make_opsetid(DOMAIN, VERSION)]
    model = helper.make_model(graph, opset_imports=opsets, ir_version=10, functions=[stereo_correlation_function(18)])
    onnx.checker.check_model(model, full_check=True)
    return model


def make_feeds(count: int, seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Smooth pictures, the right view three pixels to the left of the left one."""
    import cv2

    random = np.random.default_rng(seed)
    feeds = []
    for _ in range(count):
        coarse = random.integers(0, 256, (5, 9, 3)).astype(np.uint8)
        picture = cv2.resize(coarse, NETWORK_HW[::-1], interpolation=cv2.INTER_CUBIC).transpose(2, 0, 1)[None]
        feeds.append({"left": picture.copy(), "right": np.roll(picture, -3, axis=3)})
    return feeds


@pytest.fixture(scope="session")
def toy_bytes() -> bytes:
    return bytes(make_toy_model().SerializeToString())


@pytest.fixture
def toy_model(toy_bytes: bytes) -> onnx.ModelProto:
    """A copy of one's own."""
    return onnx.ModelProto.FromString(toy_bytes)


@pytest.fixture(scope="session")
def toy_feeds() -> list[dict[str, np.ndarray]]:
    """Eight sets of inputs."""
    return make_feeds(8)


@pytest.fixture
def toy_directory(tiny_model: Path, toy_bytes: bytes) -> Path:
    """A model directory that holds the toy network."""
    from runtime.contracts import manifest as contract

    (tiny_model / contract.MODEL_FILE).write_bytes(toy_bytes)
    manifest = contract.parse_manifest((tiny_model / contract.MANIFEST_FILE).read_text(encoding="utf-8"))
    names = (contract.MODEL_FILE, contract.PRIORS_FILE)
    manifest = dataclasses.replace(manifest, sha256={name: contract.file_sha256(tiny_model / name) for name in names})
    (tiny_model / contract.MANIFEST_FILE).write_text(contract.format_manifest(manifest), encoding="utf-8")
    return tiny_model
