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


@dataclass(frozen=True, slots=True)
class Way:
    """A way to write a placement, of those that cost nothing at run time.

    Attributes:
        prepared: The model, its recipe that of this way.
        adjustments: What the recipe's adjustments came to.
    """

    prepared: Prepared
    adjustments: Adjustments


def adjust(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    choice: Choice,
    *,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
    levels: Levels | None = None,
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
        levels: That the recipe's rounding is known to give; None works them out.
    """
    if levels is None:
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


def adjusted_ways(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    choice: Choice,
    *,
    every: bool,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> dict[str, Way]:
    """`adjust` for the model's own recipe or for each of `variants`, by their names.

    Args:
        prepared, calibration, ranges, choice: As for `adjust`.
        every: All variants, the recipe's own first; else that one alone.
        use_cache, allow_other_rig, progress: As for `adjust`.
    """
    found: dict[str, Way] = {}
    levels: dict[bool, Levels] = {}  # whether biases are corrected changes no rounding
    for name, variant in variants(prepared).items():
        rounds = variant.recipe.output_rounding
        adjustments = adjust(
            variant,
            calibration,
            ranges,
            choice,
            use_cache=use_cache,
            allow_other_rig=allow_other_rig,
            progress=progress,
            levels=levels.get(rounds),
        )
        levels[rounds] = adjustments.levels
        found[name] = Way(variant, adjustments)
        if not every:
            break
    return found


def variants(prepared: Prepared) -> dict[str, Prepared]:
    """The model with each combination of adjustments, by a name for reports; that of its own recipe first."""
    own = prepared.recipe
    rounds, corrects = ((own.output_rounding, not own.output_rounding), (own.bias_correction, not own.bias_correction))
    recipes = [
        dataclasses.replace(own, output_rounding=rounding, bias_correction=correction)
        for rounding, correction in itertools.product(rounds, corrects)
    ]
    return {recipe.adjustments: dataclasses.replace(prepared, recipe=recipe) for recipe in recipes}
