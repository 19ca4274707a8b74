"""The budget search of ``edge quantize``: what it measures on, and where it builds its models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from edge.cli.stages import say, stage_progress, warn

if TYPE_CHECKING:
    from calib.methods import Range
    from quantize.budget import BudgetResult
    from quantize.budget_kinds import Budget
    from quantize.calibration import Calibration
    from quantize.prepare import Prepared
    from runtime.contracts.manifest import ModelDirectory

RANKING_FRAMES = 2
REFINEMENTS = 4
"""Layers given back that are tried in INT8 again; each costs one run over the validation frames."""


def search_in_budget(
    prepared: Prepared,
    found: Calibration,
    writes: Mapping[str, Callable[[Path, Sequence[str]], ModelDirectory]],
    *,
    out: Path,
    validation: str,
    budget: Budget,
    ranges: Mapping[str, Range],
    allow_other_rig: bool,
) -> BudgetResult:
    """Runs the budget search in a folder beside the result; ``writes`` are the ways that cost no time, by name."""
    import tempfile
    from functools import partial

    from calib.frames import frame_feeds, say_nothing, spread_frames
    from edge.evaluation.measure import assess, measure, measurement
    from edge.evaluation.run import run_model
    from quantize.budget import search_budget
    from quantize.sensitivity import own_noise
    from runtime.sources.factory import open_sequence

    with open_sequence(validation) as source:
        say(f"measuring the float model on {len(source)} frames")
        reference = assess(run_model(prepared.source.path, source, allow_other_rig=allow_other_rig, warn=warn))
        before = measurement(reference, reference)
        budget.lost(before, before)  # nothing to measure on is said before minutes go by
        out.parent.mkdir(parents=True, exist_ok=True)
        with (
            tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as made,
            stage_progress() as progress,
        ):

            def build(write: Callable[[Path, Sequence[str]], ModelDirectory], given_back: Sequence[str]) -> Path:
                place = Path(made) / f"{len(given_back)}-in-float-{len(list(Path(made).iterdir()))}"
                write(place, given_back)
                return place

            def rank() -> list[str]:
                feeds = list(
                    frame_feeds(
                        spread_frames(source, RANKING_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig
                    )
                )
                order = own_noise(prepared, found.observation, ranges, feeds, progress=progress)
                return [item.node for item in order]

            return search_budget(
                {way: partial(build, write) for way, write in writes.items()},
                lambda place: measure(place, source, reference, allow_other_rig=allow_other_rig, warn=say_nothing),
                reference=before,
                ranking=rank,
                budget=budget,
                refinements=REFINEMENTS,
                tell=say,
            )
