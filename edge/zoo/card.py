"""The text of ``card.md``: what a model is, what it was made from, under which licence, and its limits."""

from __future__ import annotations

from pathlib import Path

from runtime.contracts.manifest import Manifest
from runtime.model_folder import CARD_FILE


def model_card(manifest: Manifest, checkpoint: Path, *, parity: str) -> str:
    """Writes the card of a freshly exported model.

    Args:
        manifest: Of the model.
        checkpoint: Its weights; a ``card.md`` beside them says what they were trained on and is taken over.
        parity: One line on how well the graph equals the network that it was exported from.
    """
    height, width = manifest.input_size_hw
    views = "a rectified stereo pair" if manifest.views == 2 else "one image"
    beside = checkpoint.parent / CARD_FILE
    origin = (
        beside.read_text(encoding="utf-8", errors="replace").strip()
        if beside.is_file()
        else "Not stated: no card.md lies beside the checkpoint. The licence of the training data applies."
    )
    return f"""# {manifest.preset}, {manifest.recipe}

Finds {", ".join(manifest.classes)} in 3D from {views}; network image {width} x {height}, {manifest.input_type} input.

## Weights, data and licence

Exported from `{checkpoint.name}`.

{origin}{_priors_line(manifest)}

## Checks

{parity}

## Limits

Made for a rig of focal length {manifest.rig.focal_px:.0f} px at network size and baseline
{manifest.rig.baseline_m:.3f} m, rectified, level, on a road. Not a safety component: objects are missed and
invented, most of all far away, hidden, cut by the image border, at night and in bad weather.
"""


def _priors_line(manifest: Manifest) -> str:
    """Where the priors come from, if that is known."""
    known = manifest.provenance.get("priors")
    return "" if known is None else f"\n\nAnchor priors: {known}."
