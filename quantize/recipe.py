"""Recipes: what is stored how, as data in ``recipes/*.json``.

A recipe says types, bits and operators; it knows no model. One recipe serves one target, that is, a kind of
runtime and instruction set; `recipe_for_target` finds it, `detect_target` names the one of this machine.
"""

from __future__ import annotations

import json
import platform
from dataclasses import dataclass, fields
from importlib.resources import files
from typing import Any, get_args

from quantize.errors import QuantizeError
from quantize.qparams import ActivationType
from runtime.machine import processor

FLOAT_RECIPE = "float32"


@dataclass(frozen=True, slots=True)
class Recipe:
    """How a model is quantised.

    Attributes:
        name: what the manifest says.
        target: what `--target` says.
        note: one line for the report: why so.
        activation_type: 8-bit type of activations.
        activation_symmetric: zero in the middle of the levels.
        weight_bits: 8, or 7 where the target adds two products in 16 bits and saturates.
        weight_per_channel: one scale an output channel.
        operators: operator types that are quantised; all others stay float.
        fold_pixels: read uint8 pixels as they are instead of normalising in float and quantising again.
        column_outputs: give each column of the output its own range, folded into the last convolution's weights.
        exact_outputs: let the 32-bit sums of last convolutions of stride 1 become the output, unrounded.
        quantize_correlation: correlate 8-bit features (QLinearStereoCorrelation) instead of dequantised ones.
        integer_moves: let operators that only move values read 8-bit tensors directly; else between a
            DequantizeLinear and a QuantizeLinear, for runtimes that want to see those.
        flatten_volumes: compute 3D convolutions as 2D ones, where the runtime's 8-bit kernel for three dimensions is
            slow (`quantize.volumes`).
        equalise: bring the channels of a tensor to like ranges, where their factors pass on.
        output_rounding: round weights so that sums stay right, not each to its nearest level (`quantize.rounding`).
        bias_correction: take the mean error of each channel out of the biases.
        verified: ``measured`` on such a machine, or ``structure`` only.
    """

    name: str
    target: str
    note: str
    activation_type: ActivationType
    activation_symmetric: bool
    weight_bits: int
    weight_per_channel: bool
    operators: tuple[str, ...]
    fold_pixels: bool
    column_outputs: bool
    exact_outputs: bool
    quantize_correlation: bool
    integer_moves: bool
    flatten_volumes: bool
    equalise: bool
    output_rounding: bool
    bias_correction: bool
    verified: str

    @property
    def adjustments(self) -> str:
        """What is adjusted at no cost at run time, in words."""
        weights = "weights rounded by what they do" if self.output_rounding else "weights to the nearest level"
        return weights + ", biases corrected" * self.bias_correction


def load_recipes() -> dict[str, Recipe]:
    """All recipes that the package brings, by target."""
    folder = files("quantize").joinpath("recipes")
    found = [
        parse_recipe(item.read_text(encoding="utf-8"), where=item.name)
        for item in folder.iterdir()
        if item.name.endswith(".json")
    ]
    return {recipe.target: recipe for recipe in sorted(found, key=lambda recipe: recipe.target)}


def recipe_for_target(target: str) -> Recipe:
    """The recipe of a target.

    Raises:
        QuantizeError: No recipe is for it.
    """
    recipes = load_recipes()
    if target not in recipes:
        raise QuantizeError(f"--target: found {target!r}; expected one of {', '.join(recipes)}; choose one of these")
    return recipes[target]


def parse_recipe(text: str, *, where: str) -> Recipe:
    """Reads a recipe strictly.

    Raises:
        QuantizeError: No JSON object, unknown or missing keys, or a value that the key does not take.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise QuantizeError(f"{where}: found no JSON ({error.msg}); expected a recipe; repair the file") from error
    keys = {item.name for item in fields(Recipe)}
    if not isinstance(data, dict) or data.keys() != keys:
        odd = sorted(set(data) ^ keys) if isinstance(data, dict) else [type(data).__name__]
        raise QuantizeError(f"{where}: found {odd[0]!r} amiss; expected exactly {', '.join(sorted(keys))}; repair it")
    for key, allowed in _ALLOWED.items():
        if data[key] not in allowed or isinstance(data[key], bool) != isinstance(allowed[0], bool):
            raise QuantizeError(f"{where}: {key}: found {data[key]!r}; expected one of {allowed}; repair it")
    return Recipe(**{**data, "operators": tuple(data["operators"])})


def detect_target(machine: str | None = None, flags: frozenset[str] | None = None) -> str:
    """The target of this machine's CPU.

    Args:
        machine: As ``platform.machine()`` names it; None asks.
        flags: CPU flags as Linux names them; None asks.

    Returns:
        ``x86-vnni`` where 8-bit products are added in 32 bits, ``x86-avx2`` where they saturate in 16,
        ``arm64``, or ``generic`` where nothing is known.
    """
    machine = (machine or platform.machine()).lower()
    flags = frozenset(processor().flags or ()) if flags is None else flags
    if machine in ("aarch64", "arm64"):
        return "arm64"
    if machine in ("x86_64", "amd64"):
        if flags & {"avx512_vnni", "avx_vnni"}:
            return "x86-vnni"
        if "avx2" in flags:
            return "x86-avx2"
    return "generic"


_SWITCHES = (
    "activation_symmetric",
    "weight_per_channel",
    "fold_pixels",
    "column_outputs",
    "exact_outputs",
    "quantize_correlation",
    "integer_moves",
    "flatten_volumes",
    "equalise",
    "output_rounding",
    "bias_correction",
)
_ALLOWED: dict[str, tuple[Any, ...]] = {
    "activation_type": get_args(ActivationType),
    "weight_bits": (7, 8),
    "verified": ("measured", "structure"),
    **dict.fromkeys(_SWITCHES, (True, False)),
}
