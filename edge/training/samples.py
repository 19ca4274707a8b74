"""From a labelled stereo frame to one training sample (paper, section III-A2: augmentation)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge.detector.presets import Preset
from edge.training.assign import AnchorTargets, assign
from edge.training.augment import change_colours, draw_colour_change
from edge.training.camera_faults import ViewFaults, exchange_rectification, with_faults
from edge.training.disparity_targets import (
    CELL_PX,
    block_matching_disparity,
    disparity_from_points,
    grey_of,
    official_grey,
    reduce_to_cells,
)
from edge.training.ground_truth import (
    ObjectLimits,
    alpha_of_yaw,
    ground_truth,
    mirror_geometry,
    mirror_objects,
)
from runtime.anchors import AnchorGrid, BoolArray, anchor_grid, usable_anchors, usable_by_class
from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray
from runtime.contracts.manifest import AnchorPriors
from runtime.contracts.objects import Objects3D
from runtime.preprocess import NetworkView, network_view, normalise, to_network_image, to_planes

MIRROR_PROBABILITY = 0.5
KEPT_CAMERAS = 64


@dataclass(frozen=True, slots=True)
class Sample:
    """One training sample.

    Attributes:
        left, right: (3, H, W) float32, normalised RGB; a mono preset has no right view.
        targets: what the anchors learn.
        disparity: (H / 4, W / 4) float32 network pixels, 0 unknown; None for a mono preset.
        labelled: False where what stands in the picture is not known: disparity alone teaches.
    """

    left: NDArray[np.float32]
    right: NDArray[np.float32] | None
    targets: AnchorTargets
    disparity: NDArray[np.float32] | None
    labelled: bool = True


class SampleMaker:
    """Turns frames and labels into samples for one preset; keeps the anchors of each camera."""

    def __init__(self, preset: Preset, priors: AnchorPriors, *, augment: bool = True) -> None:
        self._preset = preset
        self._manifest = preset.manifest(input_type="float32")
        self._priors = priors
        self._augment = augment
        self._grid: AnchorGrid = anchor_grid(preset.anchors, preset.input_size_hw)
        self._usable: dict[bytes, tuple[BoolArray, BoolArray | None]] = {}
        training = preset.training
        self._limits = ObjectLimits(
            max_truncation=training.max_truncation,
            max_occlusion=training.max_occlusion,
            min_box_height_px=training.min_box_height_px,
            ignore_neighbours=training.ignore_neighbours,
        )

    @property
    def wants_points(self) -> bool:
        """Whether frames need the points that the lidar saw."""
        return self._preset.views == 2 and self._preset.training.disparity_source == "points"

    def make(
        self,
        frame: StereoFrame,
        objects: Objects3D,
        draws: np.random.RandomState,
        *,
        points_in_camera: FloatArray | None = None,
        faults: Sequence[ViewFaults] | None = None,
    ) -> Sample:
        """Crop and resize, mirror, change colours, assign.

        Args:
            frame: a stereo pair with labels; a mono preset looks at its left view alone.
            objects: its labels, every alpha filled in (`with_every_alpha`, which `FrameChanges.of_scene` does).
            draws: the sample's own generator.
            points_in_camera: (N, 3) metres, where `wants_points`.
            faults: of the two cameras, for what the network sees; not for what supervises disparity.

        Raises:
            FrameError: the preset is stereo and the frame has one view, or it wants points and there are none.
        """
        seen = self._views(frame)
        colours_first = self._augment and self._preset.training.photometric_first
        change = draw_colour_change(draws) if self._augment else None
        mirrored = self._augment and draws.rand() < MIRROR_PROBABILITY
        if faults is not None and mirrored and len(seen) == 2:
            faults = exchange_rectification(faults)
        if faults is not None and colours_first:
            seen = with_faults(seen, faults[: len(seen)])
        view = network_view(frame.geometry, self._manifest)
        images: list[NDArray[np.generic]]
        if colours_first and change is not None:
            full = [change_colours(_rgb_float(image), change)[..., ::-1] for image in seen]
            images = [to_network_image(image, view, as_float=True) for image in full]  # type: ignore[arg-type]
        else:
            images = [to_network_image(image, view) for image in seen]
        if faults is not None and not colours_first:
            images = with_faults(images, faults[: len(images)])  # type: ignore[arg-type]
        geometry = view.geometry
        dont_care = view.to_network(objects.dont_care_boxes)
        if mirrored:
            images = [np.ascontiguousarray(image[:, ::-1]) for image in reversed(images)]
            geometry = mirror_geometry(geometry, exchange=len(seen) == 2)
            objects = mirror_objects(objects, geometry.P2)
            dont_care = dont_care[:, [2, 1, 0, 3]] * [-1, 1, -1, 1] + [geometry.image_size_wh[0] - 1, 0] * 2
        if change is not None and not colours_first:
            images = [change_colours(_rgb_float(image), change)[..., ::-1] for image in images]
        if self._preset.training.alpha_from_yaw:
            objects = alpha_of_yaw(objects, geometry.P2)
        planes = [normalise(to_planes(image), self._manifest.normalisation)[0] for image in images]
        truth = ground_truth(
            objects,
            self._preset.classes,
            geometry=geometry,
            limits=self._limits,
            dont_care_in_network=dont_care,
        )
        usable, usable_for_class = self._usable_for(geometry.P2)
        targets = assign(
            truth,
            self._grid,
            usable,
            priors=self._priors,
            claim_without_overlap=self._preset.training.claim_without_overlap,
            low_quality_matches=self._preset.training.low_quality_matches,
            usable_for_class=usable_for_class,
            depth_by_prior=self._preset.anchors.depth_by_prior,
        )
        if len(seen) == 1:
            return Sample(planes[0], None, targets, None)
        disparity = self._disparity(frame, view, mirrored=mirrored, points_in_camera=points_in_camera)
        return Sample(planes[0], planes[1], targets, disparity)

    def _disparity(
        self, frame: StereoFrame, view: NetworkView, *, mirrored: bool, points_in_camera: FloatArray | None
    ) -> NDArray[np.float32]:
        """(H / 4, W / 4) supervision of the sample; of the unmirrored left view, flipped, where that flaw is wanted."""
        training = self._preset.training
        flip = mirrored and training.mirrored_disparity == "matched"
        if training.disparity_source == "none":
            height, width = view.size_hw
            return np.zeros((height // CELL_PX, width // CELL_PX), np.float32)
        if training.disparity_source == "points":
            if points_in_camera is None:
                raise FrameError(
                    f"frame {frame.frame_id} has no points, expected a lidar's for disparity from points; "
                    "use a data set with velodyne files, or block matching"
                )
            geometry = mirror_geometry(view.geometry) if flip else view.geometry
            points = points_in_camera * [-1.0 if flip else 1.0, 1.0, 1.0]
            cells = reduce_to_cells(disparity_from_points(points, geometry))
        else:
            left, right = (self._grey(image, view) for image in self._views(frame))
            if flip:
                left, right = np.ascontiguousarray(right[:, ::-1]), np.ascontiguousarray(left[:, ::-1])
            cells = block_matching_disparity(
                left, right, disparities=training.matching_disparities, block=training.matching_block
            )
        return np.ascontiguousarray(cells[:, ::-1]) if mirrored and not flip else cells

    def _grey(self, image: NDArray[np.uint8], view: NetworkView) -> NDArray[np.uint8]:
        if self._preset.training.matching_grey == "official":
            return official_grey(to_network_image(image, view, as_float=True), self._manifest.normalisation)
        return grey_of(to_network_image(image, view))  # type: ignore[arg-type]

    def _views(self, frame: StereoFrame) -> list[NDArray[np.uint8]]:
        if self._preset.views == 1:
            return [frame.left]
        if frame.right is None:
            raise FrameError(
                f"frame {frame.frame_id} has no right image, expected a pair for the stereo preset "
                f"{self._preset.name}; use a stereo source"
            )
        return [frame.left, frame.right]

    def _usable_for(self, P2: FloatArray) -> tuple[BoolArray, BoolArray | None]:
        """Usable anchors (N,) and, where the filter asks the class, those of each class (classes, N)."""
        key = P2.tobytes()
        if key not in self._usable:
            if len(self._usable) >= KEPT_CAMERAS:  # zoomed frames have a camera each
                self._usable.clear()
            layout = self._preset.anchors
            usable = usable_anchors(self._grid, layout, priors=self._priors, P2=P2)
            by_class = usable_by_class(self._grid, layout, priors=self._priors, P2=P2)
            self._usable[key] = (usable, by_class if layout.filter_by_class else None)
        return self._usable[key]


def _rgb_float(image: NDArray[np.generic]) -> NDArray[np.float32]:
    return np.ascontiguousarray(image[..., ::-1]).astype(np.float32)
