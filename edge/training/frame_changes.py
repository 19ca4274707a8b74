"""What a run does to frames before they become samples, beyond the published augmentation: paste, zoom, camera faults.

Each has random numbers of its own for each position of the run: a change that is off, or passes a frame by, leaves all
other draws as they are, so that runs without any repeat earlier ones to the bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from edge.detector.presets import Preset
from edge.training.camera_faults import ViewFaults, draw_faults
from edge.training.ground_truth import with_every_alpha
from edge.training.object_bank import ObjectBank
from edge.training.paste import CLASS_SHARES, ObjectPaster
from edge.training.zoom import draw_zoom, zoomed
from runtime.contracts.errors import EdgeError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.objects import Objects3D
from runtime.sources.base import FrameSequence

PASTE, FAULTS, ZOOM = 1, 2, 3  # streams of random numbers of a position


@dataclass(frozen=True, slots=True)
class FrameChanges:
    """Which changes a run makes.

    Attributes:
        paster: pastes objects of other frames; None for none.
        zoom: share of frames that are zoomed.
        faults: share of frames that get camera faults.
    """

    paster: ObjectPaster | None = None
    zoom: float = 0.0
    faults: float = 0.0

    def of_scene(
        self, frame: StereoFrame, objects: Objects3D, *, seed: int, position: int, labelled: bool = True
    ) -> tuple[StereoFrame, Objects3D]:
        """The frame and its labels with objects pasted, then zoomed.

        Args:
            frame: a pair, or a single view.
            objects: its labels.
            seed, position: of the run.
            labelled: False where labels are not known: nothing is pasted.
        """
        objects = with_every_alpha(objects, frame.geometry.P2)
        if self.paster is not None and labelled:
            frame, objects = self.paster.paste(frame, objects, np.random.default_rng([seed, position, PASTE]))
        if self.zoom:
            rng = np.random.default_rng([seed, position, ZOOM])
            if rng.random() < self.zoom:
                frame, objects = zoomed(frame, objects, draw_zoom(frame.geometry, rng))
        return frame, objects

    def of_cameras(self, *, seed: int, position: int, views: int) -> tuple[ViewFaults, ...] | None:
        """Faults of the views of the frame at a position, None where it gets none."""
        if not self.faults:
            return None
        rng = np.random.default_rng([seed, position, FAULTS])
        return draw_faults(rng, views=views) if rng.random() < self.faults else None


def frame_changes(
    preset: Preset,
    sources: Sequence[FrameSequence],
    *,
    method: str | None,
    paste: float = 0.0,
    zoom: float = 0.0,
    faults: float = 0.0,
) -> FrameChanges:
    """The changes that options ask for.

    Raises:
        EdgeError: the preset or method does not go with one: pasting and zooming move what disparity is supervised with
            and want matched pairs; a zoomed picture keeps its focal length only for a model that fixes it; runs of a
            published method repeat what was published; or there is no object to paste.
    """
    for name, share in (("paste", paste), ("zoom", zoom), ("faults", faults)):
        if share and method is not None:
            raise EdgeError(f"--{name} {share:g} with --method {method}, which is as published; leave one of them out")
    for name, share in (("paste", paste), ("zoom", zoom)):
        if share and preset.views == 1:
            raise EdgeError(f"--{name} {share:g} with preset {preset.name} of one view, expected a stereo preset")
        if share and preset.training.disparity_source == "points":
            raise EdgeError(f"--{name} {share:g} with disparity from points, expected matched pairs; leave one out")
    if zoom and preset.crop.mode != "above_horizon":
        raise EdgeError(
            f"--zoom {zoom:g} with preset {preset.name}, expected one of fixed focal length, as compact; leave it out"
        )
    paster = None
    if paste:
        bank = ObjectBank(sources, [name for name in CLASS_SHARES if name in preset.classes])
        if not bank.classes:
            raise EdgeError(f"--paste {paste:g} finds no whole, near object in the datasets; add labelled frames")
        paster = ObjectPaster(bank, paste)
    return FrameChanges(paster, zoom, faults)
