"""Preprocessing parity: right pixels pass, each way to be wrong is told apart and has its remedy."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import pytest

pytest.importorskip("onnx")

import onnx
from onnx import TensorProto, helper, numpy_helper

from edge.parity import check
from edge.parity.cause import likely_cause
from edge.parity.check import check_parity
from edge.parity.network_inputs import first_convolutions
from edge.parity.reference_pixels import first_row_and_scale, normalised, reference_levels
from edge.parity.view_order import ViewOrder, view_order
from edge.report.parity import parity_table
from quantize.pixels import fold_pixels
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.manifest import AnchorLayout, Crop, Manifest, NmsPolicy, Normalisation, RigLimits, Thresholds
from runtime.preprocess import network_view, prepare

SIZE_WH, NETWORK_HW = (640, 200), (96, 320)
FOCAL_PX, BASELINE_M, DISPARITY_PX = 300.0, 0.5, 16
STATISTICS = Normalisation()
FLOAT_ROUNDING = 1e-3  # levels: float32 resize and normalisation against float64


def manifest(**changes: object) -> Manifest:
    values = {
        "preset": "toy",
        "classes": ("Car",),
        "input_size_hw": NETWORK_HW,
        "input_type": "uint8",
        "views": 2,
        "crop": Crop("top_rows", 8),
        "normalisation": STATISTICS,
        "anchors": AnchorLayout(),
        "nms": NmsPolicy(),
        "thresholds": Thresholds(),
        "rig": RigLimits(FOCAL_PX / 2, BASELINE_M),
    }
    return Manifest(**{**values, **changes})


def frame(seed: int = 0, disparity_px: int = DISPARITY_PX, size_wh: tuple[int, int] = SIZE_WH) -> StereoFrame:
    """Coloured noise; the right view shows it ``disparity_px`` further left."""
    width, height = size_wh
    coarse = np.random.default_rng(seed).integers(0, 256, (height // 8, width // 8, 3)).astype(np.uint8)
    left = cv2.resize(coarse, size_wh, interpolation=cv2.INTER_CUBIC)
    P2 = np.array([[FOCAL_PX, 0, width / 2, 0], [0, FOCAL_PX, height / 2, 0], [0, 0, 1, 0]])
    P3 = P2.copy()
    P3[0, 3] = -FOCAL_PX * BASELINE_M
    right = np.ascontiguousarray(np.roll(left, -disparity_px, axis=1))
    return StereoFrame(left, right, 0.0, seed, f"{seed:06d}", StereoGeometry(P2, P3, size_wh))


def graph(statistics: Normalisation = STATISTICS, input_type: int = TensorProto.UINT8) -> onnx.ModelProto:
    """Normalisation of both views and one convolution over them as a batch."""
    std, mean = (np.array(item, np.float32).reshape(1, 3, 1, 1) for item in (statistics.std, statistics.mean))
    weight = np.random.default_rng(1).normal(size=(4, 3, 7, 7)).astype(np.float32)
    constants = {"gain": 1 / (255 * std), "offset": -mean / std, "weight": weight}
    nodes = []
    for view in ("left", "right"):
        if input_type == TensorProto.UINT8:
            nodes += [
                helper.make_node("Cast", [view], [f"{view}_float"], to=TensorProto.FLOAT),
                helper.make_node("Mul", [f"{view}_float", "gain"], [f"{view}_scaled"]),
                helper.make_node("Add", [f"{view}_scaled", "offset"], [f"{view}_normal"]),
            ]
        else:
            nodes.append(helper.make_node("Identity", [view], [f"{view}_normal"]))
    nodes += [
        helper.make_node("Concat", ["left_normal", "right_normal"], ["both"], axis=0),
        helper.make_node("Conv", ["both", "weight"], ["out"], name="stem", strides=[2, 2], pads=[3, 3, 3, 3]),
    ]
    inputs = [helper.make_tensor_value_info(name, input_type, [1, 3, *NETWORK_HW]) for name in ("left", "right")]
    made = helper.make_graph(
        nodes,
        "toy",
        inputs,
        [helper.make_tensor_value_info("out", TensorProto.FLOAT, None)],
        [numpy_helper.from_array(value.astype(np.float32), name) for name, value in constants.items()],
    )
    return helper.make_model(made, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)


def both_models() -> dict[str, onnx.ModelProto]:
    return {"float32": graph(), "INT8": fold_pixels(graph()).model}


def test_a_graph_without_a_convolution_cannot_be_told() -> None:
    model = graph()
    del model.graph.node[-1]
    model.graph.output[0].name = "both"
    record = check_parity({"float32": model}, [frame()], manifest())
    assert [check.passed for check in record.checks if check.what == "pixels"] == [None]
    assert record.passed


def test_right_pixels_pass_folded_or_not() -> None:
    record = check_parity(both_models(), [frame(0), frame(1)], manifest())
    assert record.failures == ()
    verdicts = {(check.what, check.model): check.passed for check in record.checks}
    for model in ("float32", "INT8"):
        for view in ("left", "right"):
            assert verdicts[f"pixels, {view} view", model] is True
    assert verdicts["normalisation folded into the first convolution", "float32"] is True
    assert verdicts["left and right", ""] is True
    assert record.frame_ids == ("000000", "000001")
    ways = [check.found for check in record.checks if check.what.startswith("pixels")]
    assert [way.endswith("as they are") for way in ways] == [False, False, True, True]
    assert record.as_json()["passed"] is True
    assert len(parity_table(record).rows) == len(record.checks)


@pytest.mark.parametrize("size_wh", [SIZE_WH, (621, 187), (320, 104), (300, 60)])
@pytest.mark.parametrize("crop", [Crop("top_rows", 8), Crop("above_horizon", 50, FOCAL_PX), Crop("above_horizon", 20)])
def test_the_reference_is_what_the_runtime_feeds_in_float(size_wh: tuple[int, int], crop: Crop) -> None:
    """Two implementations without shared code, on sizes that need cutting, padding, growing and shrinking."""
    float_input = manifest(input_type="float32", crop=crop)
    seen = frame(size_wh=size_wh)
    view = network_view(seen.geometry, float_input)
    assert first_row_and_scale(seen.geometry, float_input) == pytest.approx((view.top_row, view.scale))
    feeds = prepare(seen, view, float_input)
    for name, levels in reference_levels(seen, float_input).items():
        expected = normalised(levels, STATISTICS)
        step = 255 * min(STATISTICS.std)
        assert np.abs(feeds[name][0] - expected).max() * step < FLOAT_ROUNDING


def test_a_float_input_has_the_narrow_limit() -> None:
    record = check_parity({"float32": graph(input_type=TensorProto.FLOAT)}, [frame()], manifest(input_type="float32"))
    assert record.failures == ()
    assert next(check.limit for check in record.checks) == "max 0.01"


@pytest.mark.parametrize(
    ("change", "remedy"),
    [
        (lambda feeds: {name: value[:, ::-1] for name, value in feeds.items()}, "red and blue"),
        (lambda feeds: {"left": feeds["right"], "right": feeds["left"]}, "swap the graph's inputs"),
        (lambda feeds: {name: np.roll(value, -3, axis=2) for name, value in feeds.items()}, "3 network rows too high"),
        (lambda feeds: {name: np.roll(value, 2, axis=2) for name, value in feeds.items()}, "2 network rows too low"),
        (lambda feeds: {name: value // 2 for name, value in feeds.items()}, "pixels are scaled by 0.5"),
        (lambda feeds: {name: value[:, :, :, ::-1] for name, value in feeds.items()}, "compare the manifest"),
    ],
)
def test_wrong_pixels_fail_with_the_cause(change: Callable, remedy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        check,
        "prepare",
        lambda *given: {name: np.ascontiguousarray(value) for name, value in change(prepare(*given)).items()},
    )
    record = check_parity(both_models(), [frame()], manifest())
    failed = [check for check in record.failures if check.what.startswith("pixels")]
    assert len(failed) == 4, "both views of both models"
    assert all(remedy in check.remedy for check in failed), [check.remedy for check in failed]
    assert not record.passed


def test_a_normalisation_that_is_not_the_manifests_fails() -> None:
    other = Normalisation(mean=(0.5, 0.5, 0.5), std=(0.5, 0.5, 0.5))
    record = check_parity({"float32": graph(other)}, [frame()], manifest())
    assert {check.what for check in record.failures} == {"pixels, left view", "pixels, right view"}
    assert all("normalisation is not the manifest's" in check.remedy for check in record.failures)


def test_swapped_views_of_the_source_fail() -> None:
    record = check_parity(both_models(), [frame(0, -DISPARITY_PX), frame(1, -DISPARITY_PX)], manifest())
    (failure,) = record.failures
    assert failure.what == "left and right"
    assert "swap the two views" in failure.remedy


def test_views_that_do_not_tell_are_no_failure() -> None:
    grey = np.full((3, *NETWORK_HW), 90.0)
    assert view_order(grey, grey) == ViewOrder(0, 0)
    assert ViewOrder(0, 0).right_way_round is None
    assert ViewOrder(40, 40).right_way_round is None
    assert ViewOrder(11, 0).right_way_round is None
    assert ViewOrder(12, 3).right_way_round is True
    assert ViewOrder(3, 12).right_way_round is False
    unlike = view_order(reference_levels(frame(0), manifest())["left"], reference_levels(frame(5), manifest())["left"])
    assert unlike.right_way_round is None


def test_one_view_is_checked_alone() -> None:
    model = graph()
    record = check_parity(
        {"float32": _left_alone(model)},
        [StereoFrame(frame().left, None, 0.0, 0, "a", frame().geometry)],
        manifest(views=1),
    )
    assert record.failures == ()
    assert next(check.what for check in record.checks if check.passed is not None) == "pixels, left view"
    assert not any(check.what == "left and right" for check in record.checks)


def _left_alone(model: onnx.ModelProto) -> onnx.ModelProto:
    from quantize.graph import prune

    conv = model.graph.node[-1]
    conv.input[0] = "left_normal"
    prune(model)
    del model.graph.input[1]
    return model


def test_first_convolutions_are_traced_to_their_views() -> None:
    (found,) = first_convolutions(graph())
    assert (found.views, found.zero_point, found.quantised) == (("left", "right"), None, False)
    (folded,) = first_convolutions(fold_pixels(graph()).model)
    assert folded.views == ("left", "right")
    assert folded.zero_point is not None
    joined = graph()
    joined.graph.node[-2].attribute[0].i = 1  # joined as channels: rows of the batch are no views
    assert first_convolutions(joined) == []


def with_quantised_pixels(step: float) -> onnx.ModelProto:
    """Normalised, then rounded to 8 bits before the first convolution, as for runtimes that do not fold pixels."""
    model = graph()
    del model.graph.node[-1]
    scale = numpy_helper.from_array(np.array(step, np.float32), "step")
    zero = numpy_helper.from_array(np.array(0, np.int8), "zero")
    model.graph.initializer.extend([scale, zero])
    model.graph.node.append(helper.make_node("QuantizeLinear", ["both", "step", "zero"], ["both_q"]))
    model.graph.node.append(helper.make_node("DequantizeLinear", ["both_q", "step", "zero"], ["both_dq"]))
    model.graph.node.append(helper.make_node("Conv", ["both_dq", "weight"], ["out"], name="stem"))
    return model


@pytest.mark.parametrize(("step", "passed"), [(2.7 / 127, True), (0.5 / 127, False)])
def test_rounded_pixels_pass_where_their_range_holds_them(step: float, passed: bool) -> None:
    model = with_quantised_pixels(step)
    (found,) = first_convolutions(model)
    assert (found.quantised, found.zero_point) == (True, None)
    record = check_parity({"float32": graph(), "INT8": model}, [frame()], manifest())
    checks = [check for check in record.checks if check.model == "INT8"]
    assert [check.passed for check in checks] == [passed, passed]
    assert all(check.limit == "mean 2" for check in checks)


def test_an_unknown_cause_is_not_guessed() -> None:
    random = np.random.default_rng(3)
    wanted, seen = (random.uniform(0, 255, (3, 40, 64)) for _ in range(2))
    assert "compare the manifest" in likely_cause("left", seen, {"left": wanted}, float(np.abs(seen - wanted).mean()))
