"""Training under 8-bit rounding: the network computes as its INT8 graph will, the weights stay plain floats.

Forward, every convolution's weight is rounded to 255 levels (127 with 7-bit weights) and every tensor that the INT8
graph stores in 8 bits to 256; backward, rounding counts as the identity (straight-through; Jacob et al., Quantization
and Training of Neural Networks, 2018, section 3). The places are those of `quantize.placement`: what a convolution
gives behind its norm and ReLU, sums, concatenations, pools, correlations; outputs are the unrounded sums of
`quantize.ends`. A norm that the export folds into its convolution changes no level of the weight, as each output
channel has a scale of its own. Ranges are what `calib.methods.mse_range` makes of a thinned-out batch, averaged over
steps.

Nothing of this is in the module: hooks that `FakeQuantisation.remove` takes away, no parameter, no buffer, no name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch import nn
from torch.autograd.function import once_differentiable

from calib.methods import Range, mse_range
from calib.observers import StreamingHistogram
from edge.detector.backbone import ResNetBackbone
from edge.detector.blocks import BasicBlock, Bottleneck, GhostExpansion
from edge.detector.deformable import DeformableConv2d
from edge.detector.head import AnchorHead
from edge.detector.neck import DisparityBranch, ExpandAndMix, StereoNeck
from edge.training.distributed import ALONE, Ranks, gathered
from quantize.qparams import SMALLEST_SCALE, activation_params, largest_level

FIRST_STEPS = 10
"""Steps that all measure ranges."""
REFRESH_EVERY = 25
"""Later steps between measurements: ranges follow the weights, at next to no cost."""
MEMORY = 0.9
"""Share of the old range that a later measurement keeps."""
SAMPLES = 1 << 18
"""Values of a tensor that a measurement looks at."""

_LEVELS = 255
_SPREADING = 2654435761  # prime: multiples of it, modulo any size, lie evenly and in step with no channel count
_CONVOLUTIONS = (nn.Conv2d, nn.Conv3d, DeformableConv2d)


class FakeQuantisation:
    """Puts 8-bit rounding into a detector until `remove` is called.

    Args:
        detector: a stereo or mono detector; its parameters, buffers and their names stay as they are.
        weight_bits: 8, or 7 where the target's weights have so many (`quantize.recipe`).
        ranks: this process among those that train; ranges are those of the first.
    """

    def __init__(self, detector: nn.Module, *, weight_bits: int = 8, ranks: Ranks = ALONE) -> None:
        self._weight_bits = weight_bits
        self._ranks = ranks
        self._points: dict[str, _Point] = {}
        self._undo: list[Callable[[], None]] = []
        self._steps = 0
        self._measuring = False
        training_only = {
            id(inner) for part in detector.modules() if isinstance(part, DisparityBranch) for inner in part.modules()
        }
        for name, module in detector.named_modules():
            if id(module) in training_only:
                continue
            if isinstance(module, nn.Conv2d | nn.Conv3d):
                self._round_weight(module)
            for path, output, rectified in _outputs(name, module):
                self._hook(output, self._point(path, rectified=rectified))
            if isinstance(module, StereoNeck):
                self._round_neck(name, module)
            if isinstance(module, AnchorHead) and hasattr(detector, "neck"):
                self._hook_input(module, self._point(f"{name}.input"))

    @property
    def places(self) -> tuple[str, ...]:
        """Names of the tensors that are rounded, by the module that gives or reads them."""
        return tuple(self._points)

    def begin_step(self) -> None:
        """Count a step; the first ones, and later every few, measure ranges while they go through."""
        self._measuring = self._steps < FIRST_STEPS or self._steps % REFRESH_EVERY == 0
        self._steps += 1

    def end_step(self) -> None:
        """Take the first process's ranges, where this step measured."""
        if self._measuring:
            first, *_ = gathered(self.state(), self._ranks)
            self.load_state(first)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps: steps, and (2,) float64 bounds by place."""
        bounds = {name: point.bounds.clone() for name, point in self._points.items() if point.bounds is not None}
        return {"steps": self._steps, "bounds": bounds}

    def load_state(self, state: dict[str, Any]) -> None:
        """Go on with ranges of `state`; places that it does not name measure their own."""
        self._steps = int(state["steps"])
        for name, value in state["bounds"].items():
            if name in self._points:
                self._points[name].bounds = value.clone()

    def remove(self) -> None:
        """Take all rounding out of the detector."""
        for undo in self._undo:
            undo()
        self._undo.clear()

    def _point(self, name: str, *, rectified: bool = False) -> _Point:
        self._points[name] = point = _Point(rectified=rectified)
        return point

    def _apply(self, point: _Point, x: torch.Tensor) -> torch.Tensor:
        if self._measuring:
            point.measure(x.detach(), 1 / self._steps)
        return point.rounded(x)

    def _hook(self, module: nn.Module, point: _Point) -> None:
        self._undo.append(module.register_forward_hook(lambda _module, _inputs, out: self._apply(point, out)).remove)

    def _hook_input(self, module: nn.Module, point: _Point) -> None:
        hook = module.register_forward_pre_hook(lambda _module, inputs: (self._apply(point, inputs[0]),))
        self._undo.append(hook.remove)

    def _round_weight(self, convolution: nn.Conv2d | nn.Conv3d) -> None:
        plain = convolution._conv_forward

        def rounded(x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
            return plain(x, rounded_weight(weight, bits=self._weight_bits), bias)

        convolution._conv_forward = rounded  # type: ignore[method-assign]
        self._undo.append(lambda: delattr(convolution, "_conv_forward"))

    def _round_neck(self, name: str, neck: StereoNeck) -> None:
        """Correlations are functions: they are rounded where they are read, then again with what stands beside."""
        self._hook_input(neck.four_to_eight, self._point(f"{name}.volume4"))
        if neck.shape.scale_8:
            volume, joined = self._point(f"{name}.volume8"), self._point(f"{name}.fused8")
            count = neck.shape.disparities_at_8

            def join(_module: nn.Module, inputs: tuple[torch.Tensor, ...]) -> tuple[torch.Tensor]:
                fused, correlation = inputs[0][:, :-count], inputs[0][:, -count:]
                return (self._apply(joined, torch.cat([fused, self._apply(volume, correlation)], dim=1)),)

            self._undo.append(neck.eight_to_sixteen.register_forward_pre_hook(join).remove)
        if neck.shape.scale_16:
            self._hook_input(neck.sixteen, self._point(f"{name}.fused16"))


class _Point:
    """A tensor that is stored in 8 bits.

    Attributes:
        bounds: float64 (2,), low and high; None before the first measurement.
    """

    def __init__(self, *, rectified: bool) -> None:
        self._rectified = rectified
        self.bounds: torch.Tensor | None = None

    def measure(self, x: torch.Tensor, share: float) -> None:
        """Take in a batch (B, C, ...) with at least this share; one that is not finite is passed over."""
        new = self._least_error(x)
        if new is not None:
            self.bounds = new if self.bounds is None else self.bounds.lerp(new, max(share, 1 - MEMORY))

    def rounded(self, x: torch.Tensor) -> torch.Tensor:
        """``x`` on its levels, in its own type; as it is where no range is known."""
        if self.bounds is None:
            return x
        params = activation_params(*self.bounds.tolist())
        out: torch.Tensor = _Round.apply(x, params.scale, -params.zero_point, _LEVELS - params.zero_point)
        return out

    def _least_error(self, x: torch.Tensor) -> torch.Tensor | None:
        flat = x.movedim(1, -1).reshape(-1)  # of channels-last tensors a view
        count = min(SAMPLES, flat.numel())
        picks = torch.arange(count, device=x.device) * _SPREADING % flat.numel()
        values = flat[picks].float()
        values = values.relu() if self._rectified else values
        if not bool(torch.isfinite(values).all()):
            return None
        histogram = StreamingHistogram()
        histogram.update(values.cpu().numpy())
        found: Range = mse_range(histogram.statistics())
        return torch.tensor(found, dtype=torch.float64)


class _Round(torch.autograd.Function):
    """Rounding and saturating, in float32; backward the identity."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, scale: Any, lowest: Any, highest: Any) -> torch.Tensor:
        levels = x.float() / scale
        return levels.round_().clamp_(lowest, highest).mul_(scale).to(x.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        return gradient, None, None, None


def rounded_weight(weight: torch.Tensor, *, bits: int = 8) -> torch.Tensor:
    """A convolution's weight (M, ...) on the 2^bits - 1 symmetric levels of its output channel; gradients pass."""
    top = largest_level(bits)
    peaks = weight.detach().float().abs().amax(dim=tuple(range(1, weight.dim())), keepdim=True)
    scale = (peaks / top).clamp_min(SMALLEST_SCALE)
    out: torch.Tensor = _Round.apply(weight, scale, -top, top)
    return out


def _outputs(name: str, module: nn.Module) -> Iterator[tuple[str, nn.Module, bool]]:
    """Modules directly in ``module`` (or itself) whose output is stored in 8 bits: path, module, if 0 is lowest."""
    norms: dict[str, bool] = {}
    if isinstance(module, BasicBlock):
        norms = {"bn1": True, "bn2": False}
    elif isinstance(module, Bottleneck):
        norms = {"bn1": True, "bn2": True, "bn3": False}
    for norm, rectified in norms.items():
        yield f"{name}.{norm}", getattr(module, norm), rectified
    if isinstance(module, ResNetBackbone):  # rounding commutes with the maximum, on a quarter of the values
        yield f"{name}.maxpool", module.maxpool, False
    if isinstance(module, BasicBlock | Bottleneck | GhostExpansion):
        yield name, module, False
    if isinstance(module, ExpandAndMix) and isinstance(module.pool, nn.AvgPool2d):
        yield f"{name}.pool", module.pool, False
    if isinstance(module, DeformableConv2d):
        yield f"{name}.conv_offset", module.conv_offset, False
    if isinstance(module, nn.Sequential):
        yield from _in_sequence(name, module)


def _in_sequence(name: str, layers: nn.Sequential) -> Iterator[tuple[str, nn.Module, bool]]:
    """Of a convolution: what comes behind its norm; zero is its lowest level where a ReLU follows.

    Before a dropout, so that the range is that of the finished network. A last convolution alone ends the network.
    """
    children = list(layers.named_children())
    for index, (label, layer) in enumerate(children):
        if not isinstance(layer, _CONVOLUTIONS):
            continue
        behind = [item for item in children[index + 1 :] if not isinstance(item[1], nn.Dropout2d)]
        if behind and isinstance(behind[0][1], nn.modules.batchnorm._BatchNorm):
            label, layer = behind.pop(0)
        elif not behind:
            continue
        rectified = bool(behind) and isinstance(behind[0][1], nn.ReLU)
        yield f"{name}.{label}", layer, rectified
