"""The network against intermediates recorded from the official code, at a reduced size and at the paper's."""

from __future__ import annotations

import dataclasses
import json
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.official import official_name  # noqa: E402
from edge.detector.official_shapes import expected_shapes  # noqa: E402
from edge.detector.presets import preset  # noqa: E402
from runtime.contracts.manifest import read_priors  # noqa: E402
from runtime.decode import Decoder  # noqa: E402

pytestmark = pytest.mark.torch

TRAINED_PARAMETERS, INFERENCE_PARAMETERS = 107_577_232, 100_081_936  # counted from the official code
SMALL, PAPER = (96, 320), (288, 1280)
CRC_OF_PAIRS = {SMALL: ("11d123d9", "a1965c42"), PAPER: ("80ce6f74", "16d05e32")}
PRIORS = Path(__file__).resolve().parents[2] / "golden" / "official" / "priors.npz"
PIXEL_TOLERANCE, METRIC_TOLERANCE, SCORE_TOLERANCE = 1e-2, 1e-3, 1e-4  # of boxes of two float32 networks
ALL_BUT_DETECTIONS = 25


def run_network(detector: StereoDetector, inputs: list[NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Everything that was recorded of a forward pass, by its recorded name."""
    seen: dict[str, Any] = {}
    neck, head, backbone = detector.neck, detector.head, detector.backbone
    outputs = {
        "cv16_concat": neck.concat_volume, "p48_ghost": neck.four_to_eight.ghost, "p48_pool": neck.four_to_eight.pool,
        "p48_block": neck.four_to_eight.block, "p816_ghost": neck.eight_to_sixteen.ghost,
        "p816_pool": neck.eight_to_sixteen.pool, "p816_block": neck.eight_to_sixteen.block,
        "p16_ghost": neck.sixteen.ghost, "p16_block": neck.sixteen.block, "cls_conv0_relu": head.classification[2],
        "cls_conv3_relu": head.classification[5], "reg_convbnrelu": head.regression[0], "reg_block": head.regression[1],
        "both_s4": backbone.layer1, "both_s8": backbone.layer2, "both_s16": backbone.layer3,
        "cv16_down_both": neck.concat_volume.reduce,
    }  # fmt: skip
    handles = [
        module.register_forward_hook(lambda _m, _i, output, name=name: seen.__setitem__(name, output.clone()))
        for name, module in outputs.items()
    ]
    for name, module in {"cv4_corr": neck.four_to_eight, "at_8": neck.eight_to_sixteen}.items():
        handles.append(
            module.register_forward_hook(lambda _m, given, _o, name=name: seen.__setitem__(name, given[0].clone()))
        )
    try:
        with torch.no_grad():
            seen["features"], stereo = detector.features(*(torch.from_numpy(image) for image in inputs))
            seen["cls_out"], seen["reg_out"] = detector.head(seen["features"])
            seen["disp_logits"] = detector.disparity_branch(stereo)
    finally:
        for handle in handles:
            handle.remove()
    for level in ("s4", "s8", "s16"):
        seen[f"left_{level}"], seen[f"right_{level}"] = seen.pop(f"both_{level}").chunk(2)
    seen["cv16_down_left"], seen["cv16_down_right"] = seen.pop("cv16_down_both").chunk(2)
    seen["cv8_corr"] = seen.pop("at_8")[:, preset("paper").network.neck.width_at_8 :]
    return {name: value.numpy() for name, value in seen.items()}


@pytest.fixture(scope="module")
def forward(official_detector: StereoDetector, recorded_inputs: Any) -> Callable[..., dict[str, NDArray[np.float32]]]:
    """``forward(size_hw)``, each size run once."""
    done: dict[tuple[int, int], dict[str, NDArray[np.float32]]] = {}

    def run(size_hw: tuple[int, int]) -> dict[str, NDArray[np.float32]]:
        if size_hw not in done:
            done[size_hw] = run_network(official_detector, recorded_inputs(size_hw))
        return done[size_hw]

    return run


def decoder(size_hw: tuple[int, int]) -> Decoder:
    manifest = dataclasses.replace(preset("paper").manifest(input_type="float32"), input_size_hw=size_hw)
    return Decoder(manifest, read_priors(PRIORS, manifest.classes, manifest.anchors))


def test_paper_preset_has_the_published_parameter_count() -> None:
    detector = StereoDetector(preset("paper"))
    trained, disparity = (sum(p.numel() for p in m.parameters()) for m in (detector, detector.disparity_branch))
    assert trained == TRAINED_PARAMETERS
    assert trained - disparity == INFERENCE_PARAMETERS  # the disparity branch is not exported


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_images_by_rule_are_those_recorded(by_rule: ModuleType, size_hw: tuple[int, int]) -> None:
    pair = by_rule.image_pair(*size_hw, 1000)
    assert tuple(f"{zlib.crc32(np.ascontiguousarray(image).tobytes()):08x}" for image in pair) == CRC_OF_PAIRS[size_hw]


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_network_equals_the_recorded_slices(
    size_hw: tuple[int, int], recorded_case: Callable[..., Any], forward: Callable[..., Any]
) -> None:
    case, seen = recorded_case(size_hw), forward(size_hw)
    assert set(case.tensors) <= set(seen) and len(case.tensors) >= ALL_BUT_DETECTIONS
    for name in case.tensors:
        case.check(name, case.kept(name, seen[name]), case.arrays[name])


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_detections_equal_the_recorded_ones(
    size_hw: tuple[int, int], recorded_case: Callable[..., Any], forward: Callable[..., Any]
) -> None:
    case, seen = recorded_case(size_hw), forward(size_hw)
    found = decoder(size_hw).decode_in_network(seen["cls_out"], seen["reg_out"], P2=case.P2, score=0.75)
    np.testing.assert_array_equal(found.anchor_index, case.arrays["det_anchor_index"])
    np.testing.assert_array_equal(found.class_id, case.arrays["det_label_aligned"])
    np.testing.assert_allclose(found.score, case.arrays["det_scores"], rtol=0, atol=SCORE_TOLERANCE)
    boxes = case.arrays["det_boxes"]
    np.testing.assert_allclose(found.boxes[:, :6], boxes[:, :6], rtol=0, atol=PIXEL_TOLERANCE)
    np.testing.assert_allclose(found.boxes[:, 6:], boxes[:, 6:], rtol=0, atol=METRIC_TOLERANCE)


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_usable_anchors_are_the_recorded_ones(size_hw: tuple[int, int], recorded_case: Callable[..., Any]) -> None:
    case = recorded_case(size_hw)
    np.testing.assert_array_equal(np.packbits(decoder(size_hw).usable(case.P2)), case.arrays["useful_mask_packed"])


def test_names_and_shapes_are_those_of_the_official_code(reference_dir: Path, by_rule: ModuleType) -> None:
    entries = json.loads((reference_dir / "state_dict_names.json").read_text())["entries"]
    official = {name: tuple(shape) for name, shape in entries if name not in by_rule.LOSS_CONSTANTS}
    ours = {official_name(name): shape for name, shape in expected_shapes(preset("paper")).items()}
    assert ours == official and len(ours) + len(by_rule.LOSS_CONSTANTS) == len(entries)


def test_weights_by_rule_are_those_recorded(
    reference_dir: Path, by_rule: ModuleType, official_state: Mapping[str, Any]
) -> None:
    facts = json.loads((reference_dir / "state_dict_names.json").read_text())
    checksum = 0
    for name, _ in facts["entries"]:
        constant = by_rule.LOSS_CONSTANTS.get(name)
        value = official_state[name].numpy() if constant is None else np.asarray(constant, np.float32)
        checksum = zlib.crc32(np.ascontiguousarray(value).tobytes(), checksum)
    assert f"{checksum:08x}" == "8fa1089d"


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_network_equals_the_whole_recording(
    reference_dir: Path, size_hw: tuple[int, int], recorded_case: Callable[..., Any], forward: Callable[..., Any]
) -> None:
    case, seen = recorded_case(size_hw), forward(size_hw)
    with np.load(reference_dir / f"net_{size_hw[0]}x{size_hw[1]}.npz") as recorded:
        whole = {name: recorded[name] for name in case.tensors}
    for name, expected in whole.items():
        case.check(name, case.stored(name, seen[name]), expected)


@pytest.mark.parametrize("size_hw", [SMALL, PAPER])
def test_boxes_from_recorded_outputs(
    reference_dir: Path, size_hw: tuple[int, int], recorded_case: Callable[..., Any]
) -> None:
    case = recorded_case(size_hw)
    with np.load(reference_dir / f"net_{size_hw[0]}x{size_hw[1]}.npz") as recorded:
        outputs = recorded["cls_out"], recorded["reg_out"]
    found = decoder(size_hw).decode_in_network(*outputs, P2=case.P2, score=0.75)
    np.testing.assert_array_equal(found.anchor_index, case.arrays["det_anchor_index"])
    np.testing.assert_array_equal(found.class_id, case.arrays["det_label_aligned"])
    np.testing.assert_array_equal(found.score, case.arrays["det_scores"])  # to the last bit
    np.testing.assert_array_equal(found.boxes, case.arrays["det_boxes"])


@pytest.mark.slow
def test_exported_graph_equals_the_recording_at_the_reduced_size(
    official_detector: StereoDetector, recorded_inputs: Any, recorded_case: Callable[..., Any]
) -> None:
    """In plain ONNX Runtime: the correlations are computed by the function body in the file."""
    pytest.importorskip("onnx")
    import onnxruntime

    from export.to_onnx import to_onnx

    feeds = dict(zip(("left", "right"), recorded_inputs(SMALL), strict=True))
    examples = {name: torch.from_numpy(array) for name, array in feeds.items()}
    content = to_onnx(official_detector, examples, ("cls_logits", "box_deltas")).SerializeToString()
    outputs = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"]).run(None, feeds)
    case = recorded_case(SMALL)
    for name, value in zip(("cls_out", "reg_out"), outputs, strict=True):
        case.check(name, case.kept(name, value), case.arrays[name])
