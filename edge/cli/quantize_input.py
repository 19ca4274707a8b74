"""What ``edge quantize`` is given, looked at before minutes go by: budget, place, validation frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence


def wanted_budget(max_drop: float | None, max_disagreement: float | None, validation: str | None) -> float | None:
    """The one budget that was given; None for none.

    Raises:
        QuantizeError: two budgets, one without frames to measure on, or one below zero.
    """
    from quantize.errors import QuantizeError

    if max_drop is not None and validation is None:
        raise QuantizeError("--max-drop: found no --validation; expected labelled frames to measure on; name a source")
    if max_disagreement is not None and (validation is None or max_drop is not None):
        found_instead = "no --validation" if validation is None else "--max-drop, too"
        raise QuantizeError(
            f"--max-disagreement: found {found_instead}; expected a source to measure on, and one budget; "
            "--max-drop is for labelled frames"
        )
    budget = max_drop if max_drop is not None else max_disagreement
    if budget is not None and not budget >= 0:
        option = "--max-drop" if max_drop is not None else "--max-disagreement"
        raise QuantizeError(f"{option}: found {budget:g}; expected points of 0 or more; 0.5 is strict")
    return budget


def check_out(out: Path, model: Path) -> None:
    """Whether the result will have a place.

    Raises:
        QuantizeError: it is the float model's own, or within it.
        OutputError: it is taken, or cannot be written.
    """
    from quantize.errors import QuantizeError
    from runtime.model_folder import check_place

    place, source = out.resolve(), model.resolve()
    if place == source or source in place.parents:
        raise QuantizeError(
            f"--out: found the float model's own directory {model}; expected another; choose another place"
        )
    check_place(out)


def check_validation(uri: str, classes: Sequence[str], *, labelled: bool) -> None:
    """Whether the validation frames are there and, for a budget in AP points, labelled.

    Raises:
        SourceError: they are not there, or the source is live.
        QuantizeError: ``labelled``, and no object of moderate difficulty of the model's classes is among them.
    """
    from edge.evaluation.kitti_ap import count_objects
    from edge.evaluation.rules import CLASS_RULES
    from edge.evaluation.tables import label_table
    from quantize.budget import LEVEL_MODERATE
    from quantize.errors import QuantizeError
    from runtime.sources.factory import open_sequence

    rules = [rule for rule in CLASS_RULES if rule.name in classes]
    with open_sequence(uri) as source:
        if not labelled:
            return
        for index in range(len(source)):
            labels = source.labels(index)
            if labels is None:
                continue
            table = label_table([labels])
            if any(count_objects(table, rule)[LEVEL_MODERATE] for rule in rules):
                return
    raise QuantizeError(
        f"--validation: found no labelled objects of the model's classes and moderate difficulty in {uri}; expected "
        "some for a budget in AP points; give a labelled source, or --max-disagreement instead of --max-drop"
    )
