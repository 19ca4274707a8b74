"""Object by object: which labels were found and why the others were not, which detections are inventions and of what.

KITTI's AP sums such cases up; here each keeps its name, so that they can be counted by distance, occlusion and
truncation, and looked at. The rule is simpler than the development kit's: down the scores, a detection takes the free
label of its class that it overlaps most in space, if by more than the looser of KITTI's two limits for the class
(Car 0.5, Pedestrian and Cyclist 0.25). Objects below 25 pixels and of unknown occlusion are not asked for.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.evaluation.rules import CLASS_RULES, EVALUATED_CLASSES, ClassRule
from edge.evaluation.tables import (
    DetectionTable,
    LabelTable,
    PairTable,
    check_same_frames,
    detection_table,
    distances_m,
    label_table,
    pair_table,
)
from runtime.contracts.kitti import KITTI_CLASSES
from runtime.contracts.objects import Detections3D, Objects3D

MIN_HEIGHT_PX = 25.0
LARGELY_OCCLUDED = 2
SAME_PLACE = 0.5
"""Overlap in the image from which two boxes are about the same thing."""
FOUND, LOW_SCORE, MISPLACED, OTHER_CLASS, UNSEEN = "found", "low score", "misplaced", "other class", "unseen"
DOUBLE, NOTHING_THERE = "double", "nothing there"
MISSED_REASONS = (UNSEEN, LOW_SCORE, MISPLACED, OTHER_CLASS)
INVENTED_REASONS = (NOTHING_THERE, MISPLACED, DOUBLE, OTHER_CLASS)


@dataclass(frozen=True, slots=True)
class Target:
    """A labelled object that is asked for.

    Attributes:
        frame, row: index of the frame, and of the object in its labels.
        name: class.
        distance_m: from the camera; occlusion: 0, 1, 2; truncation: share outside the image; height_px: in the image.
        score: of the detection that found it, however low; None for none.
        state: ``found`` at the score that was asked for, or why not: ``low score``, ``misplaced`` (seen in the image,
            wrong in space), ``other class``, ``unseen``.
    """

    frame: int
    row: int
    name: str
    distance_m: float
    occlusion: int
    truncation: float
    height_px: float
    score: float | None
    state: str


@dataclass(frozen=True, slots=True)
class Invention:
    """A detection that found nothing.

    Attributes:
        frame, row: index of the frame, and of the detection in its record.
        name, score, distance_m, height_px: of the detection.
        state: ``nothing there``, ``misplaced`` (an object of its class, elsewhere in space), ``double`` (another
            detection has that object), ``other class``.
    """

    frame: int
    row: int
    name: str
    score: float
    distance_m: float
    height_px: float
    state: str


@dataclass(frozen=True, slots=True)
class Outcomes:
    """All objects and all inventions of a run."""

    frames: int
    targets: tuple[Target, ...]
    inventions: tuple[Invention, ...]

    @property
    def missed(self) -> tuple[Target, ...]:
        """Objects that were not found, the tallest first."""
        return tuple(sorted((item for item in self.targets if item.state != FOUND), key=lambda item: -item.height_px))


def judge(
    labels: Sequence[Objects3D],
    detections: Sequence[Detections3D],
    *,
    score: float,
    classes: Sequence[str] = EVALUATED_CLASSES,
) -> Outcomes:
    """Tell found from missed and invented.

    Args:
        labels, detections: one record a frame, in the same order.
        score: detections from here on count; lower ones only explain a miss.
        classes: those of Car, Pedestrian, Cyclist that are asked for.

    Raises:
        FormatError: the two lists differ in length.
    """
    check_same_frames(labels, detections)
    truth, found = label_table(labels), detection_table(detections)
    pairs = pair_table(truth, found)
    near = _Neighbours(pairs)
    of_label, of_detection = _row_in_frame(truth.frame), _row_in_frame(found.frame)
    rules = [rule for rule in CLASS_RULES if rule.name in classes]
    taken = {rule.name: _greedy(rule, truth, found, near) for rule in rules}
    targets, inventions = [], []
    for rule in rules:
        finder = taken[rule.name]
        finds = {detection: label for label, detection in finder.items()}
        asked = asked_for(truth, rule)
        for label in np.flatnonzero(asked):
            detection = finder.get(int(label))
            state = _why_missed(int(label), detection, rule, found, near, finds, score)
            targets.append(
                Target(
                    int(truth.frame[label]),
                    int(of_label[label]),
                    rule.name,
                    float(distances_m(truth.solid[label])),
                    int(truth.occlusion[label]),
                    float(truth.truncation[label]),
                    _height_px(truth.box_in_left_image[label]),
                    None if detection is None else float(found.score[detection]),
                    state,
                )
            )
        own = (found.class_id == KITTI_CLASSES.index(rule.name)) & (found.score >= score)
        for detection in np.flatnonzero(own):
            state = _why_invented(int(detection), rule, truth, found, pairs, near, finder, finds, asked)
            if state is not None:
                inventions.append(
                    Invention(
                        int(found.frame[detection]),
                        int(of_detection[detection]),
                        rule.name,
                        float(found.score[detection]),
                        float(distances_m(found.solid[detection])),
                        _height_px(found.box_in_left_image[detection]),
                        state,
                    )
                )
    return Outcomes(len(labels), tuple(targets), tuple(sorted(inventions, key=lambda item: -item.score)))


def asked_for(labels: LabelTable, rule: ClassRule) -> np.ndarray:
    """(G,) whether each label is an object of the class that can be asked for."""
    height_px = labels.box_in_left_image[:, 3] - labels.box_in_left_image[:, 1]
    same = labels.class_id == KITTI_CLASSES.index(rule.name)
    return same & (height_px >= MIN_HEIGHT_PX) & (labels.occlusion <= LARGELY_OCCLUDED)


class _Neighbours:
    """Pairs by label and by detection, each with its overlap in the image and in space."""

    def __init__(self, pairs: PairTable) -> None:
        self.of_label: dict[int, list[tuple[int, float, float]]] = defaultdict(list)
        self.of_detection: dict[int, list[tuple[int, float, float]]] = defaultdict(list)
        columns = zip(pairs.label, pairs.detection, pairs.overlap["2d"], pairs.overlap["3d"], strict=True)
        for label, detection, image, space in columns:
            self.of_label[int(label)].append((int(detection), float(image), float(space)))
            self.of_detection[int(detection)].append((int(label), float(image), float(space)))


def _greedy(rule: ClassRule, truth: LabelTable, found: DetectionTable, near: _Neighbours) -> dict[int, int]:
    """Label row to the detection row that takes it; small labels are taken, too, but not asked for."""
    own = KITTI_CLASSES.index(rule.name)
    finder: dict[int, int] = {}
    rows = np.flatnonzero(found.class_id == own)
    for detection in rows[np.argsort(-found.score[rows], kind="stable")]:
        free = [
            (space, label)
            for label, _, space in near.of_detection.get(int(detection), ())
            if truth.class_id[label] == own and label not in finder and space > rule.min_overlap["3d"][-1]
        ]
        if free:
            finder[max(free)[1]] = int(detection)
    return finder


def _why_missed(
    label: int,
    detection: int | None,
    rule: ClassRule,
    found: DetectionTable,
    near: _Neighbours,
    finds: dict[int, int],
    score: float,
) -> str:
    if detection is not None:
        return FOUND if found.score[detection] >= score else LOW_SCORE
    own = KITTI_CLASSES.index(rule.name)
    there = [row for row, image, _ in near.of_label.get(label, ()) if image >= SAME_PLACE and found.score[row] >= score]
    if any(found.class_id[row] == own and row not in finds for row in there):
        return MISPLACED
    return OTHER_CLASS if any(found.class_id[row] != own for row in there) else UNSEEN


def _why_invented(
    detection: int,
    rule: ClassRule,
    truth: LabelTable,
    found: DetectionTable,
    pairs: PairTable,
    near: _Neighbours,
    finder: dict[int, int],
    finds: dict[int, int],
    asked: np.ndarray,
) -> str | None:
    """The kind of invention; None where the detection is right, or over something that is not asked for."""
    if detection in finds or _height_px(found.box_in_left_image[detection]) < MIN_HEIGHT_PX:
        return None
    if pairs.region_cover[detection] >= SAME_PLACE:
        return None
    own = KITTI_CLASSES.index(rule.name)
    neighbour = None if rule.neighbour is None else KITTI_CLASSES.index(rule.neighbour)
    there = [label for label, image, _ in near.of_detection.get(detection, ()) if image >= SAME_PLACE]
    same = [label for label in there if truth.class_id[label] == own]
    if any(not asked[label] for label in same) or any(truth.class_id[label] == neighbour for label in there):
        return None
    if any(label not in finder for label in same):
        return MISPLACED
    if same:
        return DOUBLE
    return OTHER_CLASS if there else NOTHING_THERE


def _row_in_frame(frame: np.ndarray) -> np.ndarray:
    """Index of each row within its frame; frames are in order."""
    return np.arange(len(frame)) - np.searchsorted(frame, frame, side="left")


def _height_px(box: np.ndarray) -> float:
    return float(box[3] - box[1])
