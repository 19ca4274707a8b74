"""Scores that know depth: the probability that a box is right in 3D, by what refinement learned of it.

A network's score says that something is there, not that its depth is right. Far boxes, hidden ones, and those whose
pixels match at several depths are often seen and misplaced; ranked as high as the others they cost precision where it
counts. A logistic function of the network's score and of the evidence, learned from labelled frames by `edge
confidence`, ranks them where they belong. Boxes of classes without weights keep their score.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import ManifestError
from runtime.contracts.geometry import FloatArray
from runtime.contracts.objects import Detections3D
from runtime.refinement.evidence import EVIDENCE, Refined
from runtime.refinement.occluders import OCCLUDER_SCORE

FEATURES: Final = ("logit", *EVIDENCE, "log depth", "log height", "at border")
"""The network's logit, the evidence, log of metres, log of the 2D box's pixels of height, and 1 where it meets the left
or right border of the image. Weights have one number each, and a constant."""
_LEAST_PROBABILITY = 1e-4
_LEAST_HEIGHT_PX = 4.0
_BORDER_PX = 2.0


def check_confidence(weights: Mapping[str, Sequence[float]], classes: Sequence[str]) -> None:
    """Refuse weights of other classes or of another number of features.

    Raises:
        ManifestError: they do not fit.
    """
    for name, numbers in weights.items():
        if name not in classes or len(numbers) != len(FEATURES) + 1:
            raise ManifestError(
                f"confidence has {len(numbers)} numbers for {name}, expected {len(FEATURES) + 1} for some of "
                f"{', '.join(classes)}; learn them anew with `edge confidence`"
            )


def confidence_features(refined: Refined, image_width: int) -> NDArray[np.float64]:
    """(N, 10) `FEATURES` of each box.

    Args:
        refined: boxes with the network's scores.
        image_width: camera pixels.
    """
    found = refined.detections
    boxes = found.box_in_left_image
    score = np.clip(found.score, _LEAST_PROBABILITY, 1.0 - _LEAST_PROBABILITY)
    at_border = (boxes[:, 0] < _BORDER_PX) | (boxes[:, 2] > image_width - 1 - _BORDER_PX)
    columns = (
        np.log(score / (1.0 - score)),
        *refined.evidence.T,
        np.log(found.center_in_camera[:, 2]),
        np.log(np.maximum(boxes[:, 3] - boxes[:, 1], _LEAST_HEIGHT_PX)),
        at_border.astype(np.float64),
    )
    return np.stack(columns, axis=1)


def probability(features: FloatArray, weights: FloatArray) -> FloatArray:
    """(N,) what weights, the constant last, make of (N, F) features."""
    told: FloatArray = 1.0 / (1.0 + np.exp(-(features @ weights[:-1] + weights[-1])))
    return told


def with_confidence(refined: Refined, weights: Mapping[str, Sequence[float]], image_width: int) -> Detections3D:
    """The boxes with the probabilities as scores.

    A box that the network itself doubts gets no more than the network's score, see `no_surer`.

    Args:
        refined: boxes with the network's scores.
        weights: class to one number a feature, and the constant.
        image_width: camera pixels.
    """
    found = refined.detections
    if not weights:
        return found
    features = confidence_features(refined, image_width)
    score = found.score.copy()
    for index, name in enumerate(found.class_names):
        rows = found.class_id == index
        if name in weights and rows.any():
            score[rows] = no_surer(probability(features[rows], np.array(weights[name])), found.score[rows])
    return dataclasses.replace(found, score=score)


def no_surer(told: FloatArray, network: FloatArray) -> FloatArray:
    """(N,) probabilities, but no more than the network's score where that is below `OCCLUDER_SCORE`.

    A stream decodes no such boxes, and what it shows must not depend on the score that was asked for.
    """
    return np.where(network < OCCLUDER_SCORE, np.minimum(told, network), told)
