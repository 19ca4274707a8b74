"""Bias correction: nothing to correct, one frame, and a network whose rounded weights shift its means."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")

from calib.ranges import observe  # noqa: E402
from quantize.bias_correction import bias_shifts  # noqa: E402
from quantize.errors import QuantizeError  # noqa: E402
from quantize.graph import name_nodes  # noqa: E402
from quantize.pixels import fold_pixels  # noqa: E402
from quantize.placement import place  # noqa: E402
from quantize.qdq import quantise_graph  # noqa: E402
from quantize.recipe import recipe_for_target  # noqa: E402
from runtime.session import open_session  # noqa: E402

MIN_GAIN_DB = {"cls_logits": 1.0, "box_deltas": 0.2}
"""On frames that did not correct; the errors of the deltas have little mean, so there is little to gain."""
MEAN_SHARE = 0.5
"""At most this part of the channels' mean errors stays on the frames that corrected; rounding leaves some."""
ANCHORS = 48
"""A cell of the toy network."""
COARSE = dataclasses.replace(recipe_for_target("generic"), weight_per_channel=False)
"""One 7-bit scale for all channels of a weight: what small channels hold is mostly rounding."""


@pytest.fixture
def placed(toy_model, toy_feeds):
    name_nodes(toy_model)
    model = fold_pixels(toy_model).model
    placement = place(model, COARSE)
    seen = observe(
        model,
        lambda: toy_feeds[:4],
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
    )

    def build(shifts=None, excluded=()):
        where = place(model, COARSE, excluded) if excluded else placement
        return quantise_graph(
            model, where, COARSE, ranges=seen.ranges("minmax"), channels=seen.channels, shifts=shifts
        ).model

    return model, placement, build


def run(model, feeds):
    with open_session(model.SerializeToString(), name="toy") as session:
        return [session.run(feed) for feed in feeds]


def errors(model, other, feeds, output: int):
    pairs = zip(run(model, feeds), run(other, feeds), strict=True)
    wanted, found = (np.stack(items) for items in zip(*((a[output], b[output]) for a, b in pairs), strict=True))
    return wanted, found - wanted


def test_no_frames_are_refused(placed) -> None:
    model, placement, build = placed
    with pytest.raises(QuantizeError, match="bias correction: found no frames"):
        bias_shifts(model, build(), placement, [])


def test_every_8_bit_convolution_gets_a_finite_shift_a_channel(placed, toy_feeds) -> None:
    model, placement, build = placed
    shifts = bias_shifts(model, build(), placement, toy_feeds[:1])
    channels = {
        node.name: next(t.dims[0] for t in model.graph.initializer if t.name == node.input[1])
        for node in model.graph.node
        if node.op_type == "Conv"
    }
    assert {name: shift.shape for name, shift in shifts.items()} == {name: (n,) for name, n in channels.items()}
    assert all(np.isfinite(shift).all() for shift in shifts.values())


def test_the_inputs_are_left_as_they_were(placed, toy_feeds) -> None:
    model, placement, build = placed
    quantised = build()
    before = model.SerializeToString(), quantised.SerializeToString()
    bias_shifts(model, quantised, placement, toy_feeds[:1])
    assert (model.SerializeToString(), quantised.SerializeToString()) == before


@pytest.mark.parametrize(("output", "name"), list(enumerate(MIN_GAIN_DB)))
def test_coarse_weights_lose_less_on_other_frames(placed, toy_feeds, output: int, name: str) -> None:
    model, placement, build = placed
    shifts = bias_shifts(model, build(), placement, toy_feeds[:4])
    signal, plain = errors(model, build(), toy_feeds[4:], output)
    _, corrected = errors(model, build(shifts), toy_feeds[4:], output)
    snr = [10 * np.log10((signal**2).sum() / (error**2).sum()) for error in (plain, corrected)]
    assert snr[1] - snr[0] >= MIN_GAIN_DB[name]


@pytest.mark.parametrize("output", [0, 1], ids=list(MIN_GAIN_DB))
def test_the_mean_error_of_each_channel_goes(placed, toy_feeds, output: int) -> None:
    model, placement, build = placed
    feeds = toy_feeds[:4]
    shifts = bias_shifts(model, build(), placement, feeds)
    _, plain = errors(model, build(), feeds, output)
    _, corrected = errors(model, build(shifts), feeds, output)
    channels = plain.shape[-1] * ANCHORS  # of the last convolution; the rest are frames and cells
    means = [error.reshape(-1, channels).mean(0) for error in (plain, corrected)]
    assert np.linalg.norm(means[1]) <= MEAN_SHARE * np.linalg.norm(means[0])


def test_the_shift_of_a_layer_in_float_is_not_used(placed, toy_feeds) -> None:
    model, placement, build = placed
    layers = ["ghost.cheap"]
    shifts = bias_shifts(model, build(), placement, toy_feeds[:2])
    without = {name: shift for name, shift in shifts.items() if name not in layers}
    assert build(shifts, layers) == build(without, layers)
