"""Why a network is shown other pixels than it should be: tries the usual mistakes and names the one that fits."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from edge.parity.reference_pixels import Levels

ROWS_TRIED = 8
MUCH_BETTER = 0.5
"""A cause is named where undoing it leaves at most this share of the difference."""
UNKNOWN = "compare the manifest's crop, input size and normalisation with what the model was trained on"


def likely_cause(view: str, seen: Levels, reference: Mapping[str, Levels], mean_difference: float) -> str:
    """The remedy for pixels that are off.

    Args:
        view: which; seen: (3, H, W) levels that the network reads.
        reference: view -> levels that it should read.
        mean_difference: between the two, in levels.
    """
    wanted = reference[view]
    tried: list[tuple[float, str]] = [
        (_difference(seen, wanted[::-1]), "red and blue are swapped: feed RGB, or export again from RGB weights")
    ]
    for other, levels in reference.items():
        if other != view:
            tried.append((_difference(seen, levels), f"the {other} view arrives as {view}: swap the graph's inputs"))
    for rows in range(-ROWS_TRIED, ROWS_TRIED + 1):
        if rows and wanted.shape[1] > 2 * ROWS_TRIED:
            inner = slice(ROWS_TRIED, wanted.shape[1] - ROWS_TRIED)
            moved = np.roll(seen, rows, axis=1)[:, inner]
            where = "high" if rows > 0 else "low"
            told = f"the image sits {abs(rows)} network rows too {where}: check the manifest's crop"
            tried.append((_difference(moved, wanted[:, inner]), told))
    gain, offset, left_over = _affine(seen, wanted)
    told = (
        f"pixels are scaled by {', '.join(f'{value:.3f}' for value in gain)} and shifted by "
        f"{', '.join(f'{value:.1f}' for value in offset)} levels: the graph's normalisation is not the manifest's; "
        "export again, or correct the manifest"
    )
    tried.append((left_over, told))
    best, remedy = min(tried, key=lambda item: item[0])
    return remedy if best <= MUCH_BETTER * mean_difference else UNKNOWN


def _difference(seen: Levels, wanted: Levels) -> float:
    return float(np.abs(seen - wanted).mean())


def _affine(seen: Levels, wanted: Levels) -> tuple[list[float], list[float], float]:
    """Gain and offset by channel that make ``wanted`` into ``seen``, and the mean difference that they leave."""
    gains, offsets, left_over = [], [], []
    for made, base in zip(seen, wanted, strict=True):
        centred = base - base.mean()
        power = float((centred**2).sum())
        gain = float((centred * made).sum()) / power if power > 0 else 1.0
        offset = float(made.mean() - gain * base.mean())
        gains.append(gain)
        offsets.append(offset)
        left_over.append(float(np.abs(gain * base + offset - made).mean()))
    return gains, offsets, float(np.mean(left_over))
