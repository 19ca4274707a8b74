"""The INT8 graph for any set of nodes given back to float, without running anything.

`quantize.prepare` reads the model and places the recipe on it, `quantize.calibration` runs it over frames once;
from what that saw, `build` writes as many graphs as a search over placements asks for, and `quantize.write` puts
one of them where the user wants it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

from calib.methods import Range
from calib.ranges import Observation
from quantize.bias_correction import Shifts
from quantize.placement import place
from quantize.prepare import Prepared
from quantize.qdq import Levels, QuantisedGraph, quantise_graph


def build(
    prepared: Prepared,
    observation: Observation,
    ranges: Mapping[str, Range],
    *,
    given_back: Collection[str] = (),
    shifts: Shifts | None = None,
    levels: Levels | None = None,
) -> QuantisedGraph:
    """Writes the INT8 graph.

    Args:
        prepared: The float model.
        observation: Of its whole placement.
        ranges: ``observation.ranges(method)``, made once for many builds.
        given_back: Names of nodes that stay float.
        shifts: What biases take in addition (`quantize.bias_correction`); None for nothing.
        levels: Of the weights (`quantize.rounding`); None for the nearest ones.
    """
    placement = place(prepared.model, prepared.recipe, given_back) if given_back else prepared.placement
    # A tensor can be a root only since the move that made it was given back: it had its root's range before.
    known = {name: ranges[prepared.placement.root_of.get(name, name)] for name in placement.observed}
    return quantise_graph(
        prepared.model,
        placement,
        prepared.recipe,
        ranges=known,
        channels=observation.channels,
        shifts=shifts,
        levels=levels,
    )
