"""Named detectors: everything that tells one from another, as data (paper, section IV-A for ``paper``).

``paper`` is the published network with the official code's settings. ``compact`` is the same family cut to 7.87 M
parameters and 13.4 G multiply-adds: ResNet-18, half the disparities at stride 8, narrower fusion, narrower branches of
the head, a 1x1 convolution at the end of the class branch; it looks at the band of the image around the road at a fixed
focal length, so that any camera shows it a car of 4 m at 20 m in the same number of pixels. ``mono`` is the official
code's monocular sibling with its plain head: no right view, no neck, ResNet-101, cars alone, and angles that climb to
fit the 2D box.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from runtime.contracts.errors import EdgeError
from runtime.contracts.manifest import (
    AnchorLayout,
    Crop,
    Manifest,
    NmsPolicy,
    Normalisation,
    RigLimits,
    Thresholds,
)

KITTI_FOCAL_PX = 721.5377
KITTI_ROWS = 375
KITTI_BASELINE_M = 0.5327119287764802


class PresetError(EdgeError):
    """No preset of that name."""


@dataclass(frozen=True, slots=True)
class NeckShape:
    """Widths of the stereo neck. Disparities are in cells of their scale.

    Attributes:
        expansion: how a volume's channels grow before it is fused: ``ghost`` (paper, section III-B2), ``naive`` (a 1x1
            convolution) or ``none`` (a basic block; nothing grows, and the widths below do not count).
        scale_8, scale_16: whether the volumes at strides 8 and 16 are there.
    """

    disparities_at_4: int = 24
    disparities_at_8: int = 24
    concat_features: int = 8
    concat_shifts: int = 12
    width_at_8: int = 72
    width_at_16: int = 288
    out_channels: int = 1152
    disparity_widths: tuple[int, int] = (576, 288)
    disparity_classes: int = 96
    expansion: Literal["ghost", "naive", "none"] = "ghost"
    scale_8: bool = True
    scale_16: bool = True

    @property
    def widths(self) -> tuple[int, int, int]:
        """Channels after the fusing blocks of strides 4, 8 and 16; the last are the stereo features'."""
        if self.expansion != "none":
            return self.width_at_8, self.width_at_16, self.out_channels
        first = self.disparities_at_4
        second = first + self.disparities_at_8 * self.scale_8
        return first, second, second + self.concat_features * self.concat_shifts * self.scale_16


@dataclass(frozen=True, slots=True)
class HeadShape:
    """Widths of the head; ``box_width`` None keeps the width of the features.

    ``deformable`` begins the box branch with a deformable convolution, the official code's plain monocular head.
    """

    class_width: int = 256
    box_width: int | None = None
    class_final_kernel: int = 3
    box_final_kernel: int = 3
    dropout: float = 0.3
    initial_probability: float | None = None
    deformable: bool = False


@dataclass(frozen=True, slots=True)
class NetworkShape:
    """Shapes of all parts of the network; without a neck it looks at the left view alone."""

    backbone_depth: int
    backbone_widths: tuple[int, int, int] = (64, 128, 256)
    neck: NeckShape | None = field(default_factory=NeckShape)
    head: HeadShape = field(default_factory=HeadShape)


@dataclass(frozen=True, slots=True)
class TrainingDefaults:
    """How a preset trains unless told otherwise.

    Attributes:
        class_weights: weight of the positive focal term a class.
        frozen_backbone_parts: parts of the backbone, from the stem on, whose weights stay as loaded.
        ignore_neighbours: anchors on look-alike classes (Van, sitting person) and in DontCare regions teach nothing;
            the official code takes them as background.
        low_quality_matches: every object claims the anchors of its largest overlap, however small that is.
        alpha_from_yaw: alpha is computed from the box, as decoding undoes it; else the label's own is taught.
        claim_without_overlap: an object without any overlap claims every anchor without overlap (official flaw).
        learning_rate, batch_size, gradient_clip_norm: optimiser settings.
        schedule: of the learning rate, see `edge.training.schedule`.
        epochs: length of a run unless told otherwise, 50 as in the paper (official code: 80); None for 10,000 steps.
        dead_zones: class terms below 1e-5 and box differences up to 0.01 count as zero (official; not in the paper).
        empty_images_teach: background of an image without objects enters the class loss; the official code skips it.
        disparity_source: what supervises disparity: block matching of the pair (paper), the lidar's ``points`` where
            the data set has them, or ``none`` (the paper's ablation).
        disparity_focal: coefficient of the stereo focal loss: 0 is plain cross-entropy (official); 5 is that of the
            work which the paper takes the loss from.
        disparity_valid_only: average over matched pixels (paper); else over all (official).
        mirrored_disparity: of mirrored pairs: ``matched`` on the mirrored pair itself, or ``official``, the flipped map
            of the unmirrored left view, which is wrong.
        matching_grey: ``plain`` luminance, or the ``official`` one with red and blue exchanged.
        disparity_weight, z_weight: of the disparity loss and of the depth term.
        photometric_first: colour changes before crop and resize (official) or after (the same draws on fewer pixels).
        matching_disparities, matching_block: of the block matcher that supervises disparity, network pixels.
        max_truncation, max_occlusion, min_box_height_px: objects beyond teach nothing; height in network pixels.
    """

    class_weights: tuple[float, ...]
    learning_rate: float = 1e-4
    final_learning_rate: float = 5e-6
    schedule: Literal["hold", "cosine", "cosine-step"] = "cosine"
    epochs: int | None = 50
    batch_size: int = 4
    gradient_clip_norm: float = 0.1
    frozen_backbone_parts: int = 0
    ignore_neighbours: bool = False
    low_quality_matches: bool = True
    alpha_from_yaw: bool = False
    claim_without_overlap: bool = False
    dead_zones: bool = True
    empty_images_teach: bool = False
    disparity_source: Literal["none", "block_matching", "points"] = "block_matching"
    disparity_focal: float = 0.0
    disparity_valid_only: bool = False
    mirrored_disparity: Literal["matched", "official"] = "matched"
    matching_grey: Literal["plain", "official"] = "plain"
    disparity_weight: float = 1.0
    z_weight: float = 12.0
    photometric_first: bool = True
    matching_disparities: int = 192
    matching_block: int = 25
    max_truncation: float = 1.0
    min_box_height_px: float = 0.0
    max_occlusion: int = 3


@dataclass(frozen=True, slots=True)
class Preset:
    """One detector."""

    name: str
    classes: tuple[str, ...]
    input_size_hw: tuple[int, int]
    crop: Crop
    rig: RigLimits
    network: NetworkShape
    training: TrainingDefaults
    anchors: AnchorLayout = field(default_factory=AnchorLayout)
    nms: NmsPolicy = field(default_factory=NmsPolicy)
    thresholds: Thresholds = field(default_factory=Thresholds)
    normalisation: Normalisation = field(default_factory=Normalisation)
    hill_climbing: bool = False
    depth_refinement: bool = False

    @property
    def views(self) -> Literal[1, 2]:
        """Pictures a frame that the network looks at."""
        return 1 if self.network.neck is None else 2

    @property
    def onnx_opset(self) -> int:
        """Version of the standard operators that the network needs: DeformConv came with 19."""
        return 19 if self.network.head.deformable else 18

    def manifest(self, *, input_type: str = "uint8") -> Manifest:
        """The manifest that a model of this preset starts from."""
        return Manifest(
            preset=self.name,
            classes=self.classes,
            input_size_hw=self.input_size_hw,
            input_type=input_type,  # type: ignore[arg-type]
            views=self.views,
            crop=self.crop,
            normalisation=self.normalisation,
            anchors=self.anchors,
            nms=self.nms,
            thresholds=self.thresholds,
            rig=self.rig,
            hill_climbing=self.hill_climbing,
            depth_refinement=self.depth_refinement,
        )


_PAPER_SCALE = 288 / (KITTI_ROWS - 100)
COMPACT_FOCAL_PX = 520.0

PRESETS: dict[str, Preset] = {
    "paper": Preset(
        name="paper",
        classes=("Car", "Pedestrian"),
        input_size_hw=(288, 1280),
        crop=Crop("top_rows", 100),
        rig=RigLimits(KITTI_FOCAL_PX * _PAPER_SCALE, KITTI_BASELINE_M),
        network=NetworkShape(backbone_depth=34),
        training=TrainingDefaults(class_weights=(20.0, 40.0)),
        thresholds=Thresholds(evaluate=0.75, display=0.75),
    ),
    "compact": Preset(
        name="compact",
        classes=("Car", "Pedestrian", "Cyclist"),
        input_size_hw=(192, 896),
        crop=Crop("above_horizon", 64, KITTI_FOCAL_PX),
        rig=RigLimits(COMPACT_FOCAL_PX, KITTI_BASELINE_M),
        network=NetworkShape(
            backbone_depth=18,
            neck=NeckShape(
                disparities_at_4=24,
                disparities_at_8=12,
                concat_features=8,
                concat_shifts=6,
                width_at_8=64,
                width_at_16=128,
                out_channels=192,
                disparity_widths=(96, 48),
                disparity_classes=96,
            ),
            head=HeadShape(
                class_width=128,
                box_width=192,
                class_final_kernel=1,
                box_final_kernel=3,
                dropout=0.1,
                initial_probability=0.01,
            ),
        ),
        training=TrainingDefaults(
            class_weights=(20.0, 40.0, 40.0),
            learning_rate=5e-4,
            schedule="hold",
            epochs=None,
            batch_size=8,
            gradient_clip_norm=5.0,
            frozen_backbone_parts=1,
            ignore_neighbours=True,
            photometric_first=False,
            matching_disparities=96,
            matching_block=15,
            max_truncation=0.6,
            min_box_height_px=14.0,
            max_occlusion=2,
        ),
        anchors=AnchorLayout(base_px=14.0, scales_per_octave=3.0, scale_count=12),
        nms=NmsPolicy(iou=0.4, voting_iou=0.7, depth_share=0.15),
        thresholds=Thresholds(evaluate=0.05, display=0.5),
        depth_refinement=True,
    ),
    "mono": Preset(
        name="mono",
        classes=("Car",),
        input_size_hw=(288, 1280),
        crop=Crop("top_rows", 100),
        rig=RigLimits(KITTI_FOCAL_PX * _PAPER_SCALE, KITTI_BASELINE_M),
        network=NetworkShape(
            backbone_depth=101, neck=None, head=HeadShape(class_width=512, box_width=1024, deformable=True)
        ),
        training=TrainingDefaults(class_weights=(20.0,), z_weight=3.0, low_quality_matches=False, alpha_from_yaw=True),
        anchors=AnchorLayout(ratios=(0.5, 1.0)),
        nms=NmsPolicy(iou=0.5),
        thresholds=Thresholds(evaluate=0.75, display=0.75),
        hill_climbing=True,
    ),
}


def preset(name: str) -> Preset:
    """Look a preset up.

    Raises:
        PresetError: no preset of that name.
    """
    if name not in PRESETS:
        raise PresetError(f"preset is {name!r}, expected one of {', '.join(PRESETS)}; choose one of these")
    return PRESETS[name]


def with_frozen_backbone(chosen: Preset, parts: int) -> Preset:
    """The preset with so many parts of the backbone, from the stem on, whose weights stay as loaded."""
    return replace(chosen, training=replace(chosen.training, frozen_backbone_parts=parts))
