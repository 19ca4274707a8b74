"""What a run begins with: where its priors and weights come from, for ``run.json``, the user's eye and the card."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from edge.detector.presets import Preset
from edge.detector.weights import check_ablations, check_priors, has_disparity_branch
from edge.zoo.priors import BUNDLED_ORIGIN, bundled_priors
from runtime.contracts.errors import CheckpointError
from runtime.contracts.manifest import PRIORS_FILE, AnchorPriors, file_sha256
from runtime.model_folder import CARD_FILE
from runtime.sources.base import FrameSequence
from runtime.sources.pairs import ImagePairs


def priors_origin(out: Path, preset: Preset, given: Path | None) -> str:
    """Where `edge.training.start.run_priors` takes a run's priors from; to be asked before it does."""
    if (out / PRIORS_FILE).exists():
        return str(out / PRIORS_FILE)
    if given is not None:
        return str(given)
    return BUNDLED_ORIGIN if bundled_priors(preset) is not None else "computed from the datasets' labels"


def start_notes(
    start: Path | None,
    preset: Preset,
    priors: AnchorPriors,
    *,
    backbone: Path | None,
    resume: bool,
    grown: Sequence[str] = (),
) -> list[str]:
    """What a user should know of weights that a run starts from: that they were trained for something else, or never.

    It is no error: a run may lead away from what its weights were, it only begins with boxes that are off.
    """
    notes = []
    if start is None and backbone is None and not resume:
        frozen = preset.training.frozen_backbone_parts
        kept = "its norms" if not frozen else f"its norms and the first {frozen} of its parts"
        notes.append(
            f"the backbone is random, and {kept} will not learn; --backbone or --start give it trained weights"
        )
    for check in (
        lambda path: check_priors(path, priors, preset.classes),
        lambda path: check_ablations(path, preset),
    ):
        try:
            if start is not None:
                check(start)
        except CheckpointError as error:
            notes.append(f"{error}, or let the run learn the difference")
    if grown:
        names = ", ".join(grown)
        notes.append(f"{start} has smaller kernels in {names}: each begins in the middle of the larger one's zeros")
    if start is not None and preset.views == 2 and not has_disparity_branch(start):
        notes.append(f"{start} has no disparity branch, which training uses: it starts anew")
    return notes


def origin_card(*, start: Path | None, priors: Path | None, origin: str) -> str | None:
    """What the run's ``card.md`` says of what it began with: a licence of weights or priors goes on to what they teach.

    Args:
        start: weights that the run starts from.
        priors: that were given.
        origin: of the priors, see `priors_origin`.

    Returns:
        Text; None where nothing that it began with has a card or a licence.
    """
    names: dict[Path, list[str]] = {}
    for file in (start, priors):
        card = None if file is None else file.parent / CARD_FILE
        if file is not None and card is not None and card.is_file():
            names.setdefault(card, []).append(f"`{file.name}`")
    parts = [f"Anchor priors: {origin}."] if origin == BUNDLED_ORIGIN else []
    for card, files in names.items():
        text = card.read_text(encoding="utf-8", errors="replace").strip()
        parts.append(
            f"Trained on from {' and '.join(files)}. Their licence holds for what came of them, too; the figures below "
            f"are theirs, not those of the model that was trained. Their card:\n\n{text}"
        )
    return "\n\n".join(parts) + "\n" if parts else None


def overlap_notes(datasets: Sequence[FrameSequence], validation: FrameSequence) -> list[str]:
    """That frames which validate train, too: the best weights would be those that know them by heart."""
    taught = {path for source in datasets for path in _left_images(source)}
    shared = sum(path in taught for path in _left_images(validation))
    if not shared:
        return []
    return [f"{shared} of {len(validation)} validation frames train, too: their AP flatters; validate on others"]


def _left_images(source: FrameSequence) -> list[Path]:
    return [source.left_image(row) for row in range(len(source))] if isinstance(source, ImagePairs) else []


def origin_record(
    *, method: str | None, priors: str, start: Path | None, backbone: Path | None, validation: str | None
) -> dict[str, str]:
    """All of it by name, files with their SHA-256; what was not given is left out."""
    record = {"method": method or "preset", "priors": priors}
    for name, file in (("start", start), ("backbone", backbone)):
        if file is not None:
            record |= {name: str(file), f"{name}_sha256": file_sha256(file)}
    return record if validation is None else record | {"validation": validation}
