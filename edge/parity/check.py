"""Preprocessing parity: before 8 bits are blamed, check that both models are shown the right pixels.

What reaches the first convolution of each graph, fed as the runtime feeds it, is held against `reference_pixels` in
levels of a pixel: image size, crop, order of channels and normalisation at once, the last also where it was folded
into the convolution. Which view is the left one is decided by the pictures themselves. Where something is off, the
likely cause is looked for, so that the remedy can be named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import onnx

from edge.parity.cause import likely_cause
from edge.parity.network_inputs import FirstConvolution, first_convolutions, levels_read, values_at
from edge.parity.reference_pixels import Levels, first_row_and_scale, reference_levels
from edge.parity.view_order import ViewOrder, view_order
from edge.report.parity import ParityCheck, ParityRecord
from edge.report.rows import NO_VALUE
from quantize.pixels import fold_pixels
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.manifest import Manifest
from runtime.preprocess import network_view, prepare

BYTE_LIMIT = 1.0
"""Levels; OpenCV's 8-bit resize rounds twice and was never seen further off than 0.79."""
FLOAT_LIMIT = 0.01
"""Levels; a float32 resize and normalisation were never seen further off than 0.0001."""
QUANTISED_MEAN_LIMIT = 2.0
"""Levels, of the mean: pixels normalised and then rounded to 8 bits; one step is about a level, and the ends may be
cut off."""
FOLDING_LIMIT = 1e-3
"""Share of the deviation of the first convolution's output, inside the image; float32 sums in another order."""
SCALE_LIMIT_PX = 1.0
"""Network pixels between where the geometry puts a camera pixel and where the resize puts it."""


def check_parity(
    models: Mapping[str, onnx.ModelProto], frames: Sequence[StereoFrame], manifest: Manifest
) -> ParityRecord:
    """Look at a few frames through each model.

    Args:
        models: name -> graph; all share the manifest's input. The first is the float one, as it was exported.
        frames: a few calibration frames.
        manifest: of the model.

    Raises:
        FrameError: a frame lacks a view, or is too small.
        SessionError: a graph cannot be run.
    """
    references = [reference_levels(frame, manifest) for frame in frames]
    feeds = [prepare(frame, network_view(frame.geometry, manifest), manifest) for frame in frames]
    checks = [check for name, model in models.items() for check in _pixels(name, model, feeds, references, manifest)]
    checks += _folding(*next(iter(models.items())), feeds[:1])
    checks.append(_scale([frame.geometry for frame in frames], manifest))
    if manifest.views == 2:
        checks.append(_order(references))
    return ParityRecord(tuple(checks), tuple(frame.frame_id for frame in frames))


def _pixels(
    name: str,
    model: onnx.ModelProto,
    feeds: Sequence[Mapping[str, Any]],
    references: Sequence[Mapping[str, Levels]],
    manifest: Manifest,
) -> list[ParityCheck]:
    """One check a view: levels at the first convolution against the reference, over all frames."""
    found = first_convolutions(model)
    if not found:
        why = "no convolution reads the images"
        return [ParityCheck("pixels", name, why, NO_VALUE, None, "look at the graph's first nodes")]
    seen: dict[str, list[Levels]] = {}
    for feed in feeds:
        values = values_at(model, [item.tensor for item in found], feed)
        for item in found:
            for view, levels in levels_read(item, values[item.tensor], manifest.normalisation).items():
                seen.setdefault(view, []).append(levels)
    per_frame = {view: len(levels) // len(feeds) for view, levels in seen.items()}
    return [
        _one_view(name, view, levels, [ref for ref in references for _ in range(per_frame[view])], found[0], manifest)
        for view, levels in seen.items()
    ]


def _one_view(
    name: str,
    view: str,
    seen: Sequence[Levels],
    references: Sequence[Mapping[str, Levels]],
    convolution: FirstConvolution,
    manifest: Manifest,
) -> ParityCheck:
    what = f"pixels, {view} view"
    shapes = seen[0].shape, references[0][view].shape
    if shapes[0] != shapes[1]:
        remedy = "export the model again: its input is not the manifest's"
        return ParityCheck(what, name, f"{shapes[0][1:]} pixels", f"{shapes[1][1:]}", False, remedy)
    wrong = [np.abs(levels - reference[view]) for levels, reference in zip(seen, references, strict=True)]
    mean, worst = float(np.mean([item.mean() for item in wrong])), float(max(item.max() for item in wrong))
    way = "as they are" if convolution.zero_point is not None else "normalised"
    found = f"mean {mean:.3f}, max {worst:.3f} levels, read {way}"
    if convolution.quantised:
        passed, limit = mean <= QUANTISED_MEAN_LIMIT, f"mean {QUANTISED_MEAN_LIMIT:g}"
    else:
        bound = BYTE_LIMIT if manifest.input_type == "uint8" else FLOAT_LIMIT
        passed, limit = worst <= bound, f"max {bound:g}"
    remedy = "" if passed else likely_cause(view, seen[0], references[0], mean)
    return ParityCheck(what, name, found, limit, passed, remedy)


def _folding(name: str, model: onnx.ModelProto, feeds: Sequence[Mapping[str, Any]]) -> list[ParityCheck]:
    """Whether the first convolution answers the same once the normalisation is folded into it."""
    folding = fold_pixels(model)
    if folding.reason is not None:
        return []
    outputs = {item.node: item.output for item in first_convolutions(model) if item.node in folding.folded}
    worst = 0.0
    for feed in feeds:
        before = values_at(model, list(outputs.values()), feed)
        after = values_at(folding.model, list(outputs.values()), feed)
        for output in outputs.values():
            inside = _inside(before[output])
            deviation = float(before[output].std()) or 1.0
            worst = max(worst, float(np.abs(before[output] - after[output])[inside].max(initial=0.0)) / deviation)
    passed = worst <= FOLDING_LIMIT
    remedy = "" if passed else "quantise with a recipe that does not fold pixels, and report the graph"
    found = f"{worst:.1e} of the output's deviation"
    return [
        ParityCheck(
            "normalisation folded into the first convolution", name, found, f"{FOLDING_LIMIT:g}", passed, remedy
        )
    ]


def _inside(values: np.ndarray) -> tuple[slice, ...]:
    """Output pixels whose windows do not reach the padded border, for kernels up to 9 pixels at stride 2."""
    margin = min(4, (values.shape[2] - 1) // 2, (values.shape[3] - 1) // 2)
    return (slice(None), slice(None), slice(margin, values.shape[2] - margin), slice(margin, values.shape[3] - margin))


def _scale(geometries: Sequence[StereoGeometry], manifest: Manifest) -> ParityCheck:
    """The resize goes to whole pixels; the geometry of the network's image has the exact factor."""
    off = 0.0
    for geometry in geometries:
        width, height = geometry.image_size_wh
        first_row, scale = first_row_and_scale(geometry, manifest)
        for length in (width, min(height - max(first_row, 0), round(manifest.input_size_hw[0] / scale))):
            off = max(off, abs(round(length * scale) - length * scale))
    passed = off <= SCALE_LIMIT_PX
    remedy = "" if passed else "check the image size that the calibration names"
    return ParityCheck(
        "place of pixels", "", f"{off:.2f} network pixels at the far border", f"{SCALE_LIMIT_PX:g}", passed, remedy
    )


def _order(references: Sequence[Mapping[str, Levels]]) -> ParityCheck:
    total = ViewOrder()
    for reference in references:
        if "right" in reference:
            total += view_order(reference["left"], reference["right"])
    verdict = total.right_way_round
    remedy = {
        True: "",
        False: "swap the two views: what is near must lie further left in the right one",
        None: "use frames with more to see in both views",
    }[verdict]
    found = f"{total.further_left} blocks with disparity above 0, {total.further_right} below"
    return ParityCheck("left and right", "", found, "most above 0", verdict, remedy)
