"""What an accuracy budget limits: points of AP, boxes that differ, or centimetres of shift."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from quantize.errors import QuantizeError
from runtime.contracts.measurement import NEAR_BAND, NEAR_M, Measurement

LEVEL_MODERATE = 1


@dataclass(frozen=True, slots=True)
class Budget:
    """How much of what may be lost.

    Attributes:
        option: of ``edge quantize``, one of `KINDS`.
        limit: most that may be lost, in the unit.
    """

    option: str
    limit: float

    def __post_init__(self) -> None:
        """Raises QuantizeError where the limit is negative or not a number."""
        if not self.limit >= 0:
            raise QuantizeError(f"{self.option}: found {self.limit:g}; {KINDS[self.option].expected}")

    @property
    def unit(self) -> str:
        """What is counted, in words that follow a number."""
        return KINDS[self.option].unit

    @property
    def labelled(self) -> bool:
        """Whether it needs labels to measure on."""
        return KINDS[self.option].labelled

    def lost(self, reference: Measurement, other: Measurement) -> float:
        """What a model lost against the float model, in the unit; below zero where it won.

        Raises:
            QuantizeError: the frames have nothing to measure it on.
        """
        return KINDS[self.option].lost(reference, other)


def ap_drop_points(reference: Measurement, other: Measurement) -> float:
    """Points of 3D AP (R40, moderate) lost by the class that lost most.

    Each class counts at its loosest 3D overlap, where few objects say most; classes without moderate
    objects are left out.

    Raises:
        QuantizeError: No class has moderate objects to measure on.
    """
    lost = []
    for name, metrics in reference.ap.items():
        if reference.objects.get(name, [0, 0, 0])[LEVEL_MODERATE] == 0 or "3d" not in metrics:
            continue
        overlap = min(metrics["3d"], key=float)
        before = metrics["3d"][overlap]["R40"][LEVEL_MODERATE]
        lost.append(before - other.ap[name]["3d"][overlap]["R40"][LEVEL_MODERATE])
    if not lost:
        raise QuantizeError(
            "--validation: found no labelled objects of the model's classes and moderate difficulty; expected some for "
            "a budget in AP points; give a labelled source"
        )
    return max(lost)


def disagreement_points(other: Measurement) -> float:
    """Share of detections without a partner in the float model's, in points of 100; needs no labels.

    Raises:
        QuantizeError: The measurement was not compared with the float model.
    """
    if other.agreement is None:
        raise QuantizeError("--max-disagreement: found no comparison; expected one with the float model; measure both")
    return 100.0 * (1.0 - other.agreement.matched_share)


def shift_cm(reference: Measurement, other: Measurement) -> float:
    """Mean shift of the centres of matched boxes of `NEAR_BAND`, in centimetres; needs no labels.

    A model that shows none of the boxes there counts as if each were off by the whole of `NEAR_M`.

    Args:
        reference: The float model, compared with itself.
        other: The model, compared with it.

    Raises:
        QuantizeError: One was not compared, or the float model shows no box that near.
    """
    if reference.agreement is None or other.agreement is None:
        raise QuantizeError("--max-shift: found no comparison; expected one with the float model; measure both")
    if NEAR_BAND not in reference.agreement.centre_error_m:
        raise QuantizeError(
            f"--max-shift: found no box of the float model within {NEAR_M:g} m; expected some; give frames with near "
            "objects, or --max-disagreement instead"
        )
    _, mean_m = other.agreement.centre_error_m.get(NEAR_BAND, (NEAR_M, NEAR_M))
    return 100.0 * mean_m


@dataclass(frozen=True, slots=True)
class _Kind:
    unit: str
    labelled: bool
    lost: Callable[[Measurement, Measurement], float]
    expected: str


KINDS: Final[Mapping[str, _Kind]] = MappingProxyType(
    {
        "--max-drop": _Kind(
            "points lost",
            True,
            ap_drop_points,
            "expected points of 0 or more; 0.5 is strict",
        ),
        "--max-disagreement": _Kind(
            "% of detections unlike",
            False,
            lambda _, after: disagreement_points(after),
            "expected per cent of 0 or more; 2 is strict",
        ),
        "--max-shift": _Kind(
            "cm of shift",
            False,
            shift_cm,
            "expected centimetres of 0 or more; 5 is strict",
        ),
    }
)
"""By option: unit, labels, measure, and what a limit that makes no sense is told."""
