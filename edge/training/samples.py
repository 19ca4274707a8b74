"""From a labelled stereo frame to one training sample (paper, section III-A2: augmentation)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.detector.presets import Preset
from edge.training.assign import AnchorTargets, assign
from edge.training.augment import change_colours, draw_colour_change
from edge.training.disparity_targets import block_matching_disparity
from edge.training.ground_truth import ObjectLimits, ground_truth, mirror_geometry, mirror_objects
from runtime.anchors import AnchorGrid, BoolArray, anchor_grid, usable_anchors
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray
from runtime.contracts.manifest import AnchorPriors
from runtime.contracts.objects import Objects3D
from runtime.preprocess import network_view, normalise, to_network_image, to_planes

MIRROR_PROBABILITY = 0.5


@dataclass(frozen=True, slots=True)
class Sample:
    """One training sample.

    Attributes:
        left, right: (3, H, W) float32, normalised RGB.
        targets: what the anchors learn.
        disparity: (H / 4, W / 4) float32 network pixels, 0 unknown.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32]
    targets: AnchorTargets
    disparity: NDArray[np.float32]


class SampleMaker:
    """Turns frames and labels into samples for one preset; keeps the anchors of each camera."""

    def __init__(self, preset: Preset, priors: AnchorPriors, *, augment: bool = True) -> None:
        self._preset = preset
        self._manifest = preset.manifest(input_type="float32")
        self._priors = priors
        self._augment = augment
        self._grid: AnchorGrid = anchor_grid(preset.anchors, preset.input_size_hw)
        self._usable: dict[bytes, BoolArray] = {}
        training = preset.training
        self._limits = ObjectLimits(
            max_truncation=training.max_truncation,
            max_occlusion=training.max_occlusion,
            min_box_height_px=training.min_box_height_px,
            ignore_neighbours=training.ignore_neighbours,
        )

    def make(self, frame: StereoFrame, objects: Objects3D, draws: np.random.RandomState) -> Sample:
        """Crop and resize, mirror, change colours, assign.

        Args:
            frame: a stereo pair with labels.
            objects: its labels.
            draws: the sample's own generator.
        """
        assert frame.right is not None  # sources of pairs; the loop asks for stereo sources
        view = network_view(frame.geometry, self._manifest)
        colours_first = self._augment and self._preset.training.photometric_first
        change = draw_colour_change(draws) if self._augment else None
        raw = [to_network_image(image, view) for image in (frame.left, frame.right)]
        images: list[NDArray[np.generic]] = list(raw)
        if colours_first and change is not None:
            full = [change_colours(_rgb_float(image), change)[..., ::-1] for image in (frame.left, frame.right)]
            images = [to_network_image(image, view, as_float=True) for image in full]  # type: ignore[arg-type]
        geometry = view.geometry
        dont_care = view.to_network(objects.dont_care_boxes)
        if self._augment and draws.rand() < MIRROR_PROBABILITY:
            raw = [np.ascontiguousarray(image[:, ::-1]) for image in reversed(raw)]
            images = [np.ascontiguousarray(image[:, ::-1]) for image in reversed(images)]
            geometry = mirror_geometry(geometry)
            objects = mirror_objects(objects, geometry.P2)
            dont_care = dont_care[:, [2, 1, 0, 3]] * [-1, 1, -1, 1] + [geometry.image_size_wh[0] - 1, 0] * 2
        if change is not None and not colours_first:
            images = [change_colours(_rgb_float(image), change)[..., ::-1] for image in images]
        left, right = (normalise(to_planes(image), self._manifest.normalisation)[0] for image in images)
        truth = ground_truth(
            objects,
            self._preset.classes,
            geometry=geometry,
            limits=self._limits,
            dont_care_in_network=dont_care,
        )
        targets = assign(
            truth,
            self._grid,
            self._usable_for(geometry.P2),
            priors=self._priors,
            claim_without_overlap=self._preset.training.claim_without_overlap,
        )
        grey = [cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) for image in raw]
        disparity = block_matching_disparity(
            grey[0],
            grey[1],
            disparities=self._preset.training.matching_disparities,
            block=self._preset.training.matching_block,
        )
        return Sample(left, right, targets, disparity)

    def _usable_for(self, P2: FloatArray) -> BoolArray:
        key = P2.tobytes()
        if key not in self._usable:
            self._usable[key] = usable_anchors(self._grid, self._preset.anchors, priors=self._priors, P2=P2)
        return self._usable[key]


def _rgb_float(image: NDArray[np.generic]) -> NDArray[np.float32]:
    return np.ascontiguousarray(image[..., ::-1]).astype(np.float32)
