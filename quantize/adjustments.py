"""What brings an INT8 graph closer to the float one at no cost at run time: rounded weights, corrected biases.

A recipe says which of them a target gets; a budget search may try the others, too, before a layer goes back to float.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from calib.choice import Choice
from calib.methods import Range
from calib.ranges import Progress, no_progress
from quantize.bias_correction import Shifts
from quantize.calibration import Calibration, corrections
from quantize.prepare import Prepared
from quantize.qdq import Levels, QuantisedGraph
from quantize.recipe import Recipe
from quantize.rounding import roundings
from quantize.static import build


@dataclass(frozen=True, slots=True)
class Adjustments:
    """Of one placement with its ranges.

    Attributes:
        levels: of weights that do not go to their nearest level (`quantize.rounding`).
        shifts: what biases take in addition (`quantize.bias_correction`).
    """

    levels: Levels = field(default_factory=dict)
    shifts: Shifts = field(default_factory=dict)


def adjust(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    choice: Choice,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Adjustments:
    """The adjustments of the model's recipe, from the first few calibration frames.

    Args:
        prepared: The float model.
        calibration: Of its whole placement.
        ranges: Of its tensors, those that the build will use.
        choice: Of `quantize.calibration.choose_frames`, its source still entered.
        use_cache: Look for, and keep, results in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.
    """
    levels = roundings(
        prepared,
        calibration,
        ranges,
        choice,
        use_cache=use_cache,
        allow_other_rig=allow_other_rig,
        progress=progress,
    )
    shifts = corrections(
        prepared,
        calibration,
        ranges,
        choice,
        levels=levels,
        use_cache=use_cache,
        allow_other_rig=allow_other_rig,
        progress=progress,
    )
    return Adjustments(levels, shifts)


def build_adjusted(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    adjusted: Adjustments,
    *,
    given_back: Collection[str] = (),
) -> QuantisedGraph:
    """`quantize.static.build` with the adjustments in it."""
    return build(
        prepared,
        calibration.observation,
        ranges,
        given_back=given_back,
        shifts=adjusted.shifts,
        levels=adjusted.levels,
    )


def variants(prepared: Prepared) -> dict[str, Prepared]:
    """The model with each combination of adjustments, by a name for reports; that of its own recipe first."""
    own = prepared.recipe
    rounds, corrects = ((own.output_rounding, not own.output_rounding), (own.bias_correction, not own.bias_correction))
    recipes = [
        dataclasses.replace(own, output_rounding=rounding, bias_correction=correction)
        for rounding, correction in itertools.product(rounds, corrects)
    ]
    return {adjustments_name(recipe): dataclasses.replace(prepared, recipe=recipe) for recipe in recipes}


def adjustments_name(recipe: Recipe) -> str:
    """In words."""
    weights = "weights rounded by what they do" if recipe.output_rounding else "weights to the nearest level"
    return weights + ", biases corrected" * recipe.bias_correction
