"""What ``edge quantize`` is given, looked at before minutes go by: budget, place, validation frames."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from quantize.budget_kinds import Budget


def wanted_budget(given: Mapping[str, float | None], validation: str | None) -> Budget | None:
    """The one budget that was given, by its option; None for none.

    Raises:
        QuantizeError: two budgets, one without frames to measure on, or one below zero.
    """
    from quantize.budget_kinds import Budget
    from quantize.errors import QuantizeError

    budgets = [Budget(option, limit) for option, limit in given.items() if limit is not None]
    if not budgets:
        return None
    budget, *others = budgets
    if others:
        raise QuantizeError(
            f"{others[0].option}: found {budget.option}, too; expected one budget; --max-drop is for labelled frames"
        )
    if validation is None:
        frames = "labelled frames" if budget.labelled else "frames"
        raise QuantizeError(f"{budget.option}: found no --validation; expected {frames} to measure on; name a source")
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
    from quantize.budget_kinds import LEVEL_MODERATE
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
        "some for a budget in AP points; give a labelled source, or --max-disagreement or --max-shift instead of "
        "--max-drop"
    )
