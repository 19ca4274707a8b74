"""Three steps of a tiny network, alone or as one of several processes; `test_distributed` starts it.

``two_process_worker.py OUT`` writes losses, gradients and parameters to OUT/METHOD/result-RANK-of-COUNT.npz.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from edge.detector.network import StereoDetector
from edge.detector.presets import HeadShape, NeckShape, NetworkShape, Preset, preset
from edge.training.distributed import Ranks, process_group
from edge.training.loop import train
from edge.training.methods import METHODS, with_method
from edge.training.run_record import RunSettings
from edge.training.samples import SampleMaker
from edge.training.stream import MixedFrames
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import parse_labels
from runtime.contracts.manifest import AnchorPriors
from runtime.contracts.objects import Objects3D

STEPS, BATCH = 3, 4
EMPTY = "empty"
CARS_A_FRAME = (3, 0, 1, 2, 1, 0)  # shares differ in their objects, so that the normalisers matter
CAR = "Car 0.00 0 -1.58 {x} 173.33 {x2} 200.12 1.65 1.67 3.64 -0.65 1.71 26.70 -1.59\n"
P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])


class DrawnFrames:
    """Six labelled pairs that need no files; as much of a `FrameSequence` as training asks for."""

    def __len__(self) -> int:
        return len(CARS_A_FRAME)

    def labels(self, index: int) -> Objects3D:
        return parse_labels("".join(CAR.format(x=300 + 250 * n, x2=360 + 250 * n) for n in range(CARS_A_FRAME[index])))

    def __getitem__(self, index: int) -> StereoFrame:
        left, right = np.random.default_rng(index).integers(40, 200, (2, 375, 1242, 3)).astype(np.uint8)
        return StereoFrame(
            left=left,
            right=right,
            timestamp_secs=0.0,
            sequence=index,
            frame_id=f"{index:06d}",
            geometry=StereoGeometry(P2, P3, (1242, 375)),
        )


class EmptyFrames(DrawnFrames):
    """The same pairs without objects: they teach background alone."""

    def labels(self, index: int) -> Objects3D:
        return parse_labels("")


def tiny_preset() -> Preset:
    """The compact preset's structure, 16 channels wide, without dropout."""
    compact = preset("compact")
    neck = NeckShape(16, 8, 8, 4, 16, 16, 16, (16, 16), 96)
    network = NetworkShape(18, (16, 16, 16), neck, HeadShape(16, 16, 1, 1, 0.0, 0.01))
    training = replace(compact.training, gradient_clip_norm=0.1)
    rig = replace(compact.rig, focal_px=260.0)
    return replace(compact, input_size_hw=(96, 448), rig=rig, network=network, training=training)


def plain_priors(chosen: Preset) -> AnchorPriors:
    shape = (len(chosen.classes), chosen.anchors.scale_count, len(chosen.anchors.ratios), 6)
    mean = np.broadcast_to(np.array([25, 0, -0.5, 1.6, 1.5, 3.9], np.float32), shape).copy()
    return AnchorPriors(mean, np.broadcast_to(np.array([8, 0.7, 0.7, 0.2, 0.2, 0.5], np.float32), shape).copy())


def run(out: Path) -> None:
    """Train three steps with frozen norms by each method, and write what came of each step."""
    with process_group("cpu") as (ranks, device):
        for method in METHODS:  # their losses have other normalisers
            (out / method).mkdir(exist_ok=True)
            train_with(with_method(tiny_preset(), method), DrawnFrames(), out / method, ranks=ranks, device=device)
        (out / EMPTY).mkdir(exist_ok=True)
        train_with(with_method(tiny_preset(), "paper"), EmptyFrames(), out / EMPTY, ranks=ranks, device=device)


def train_with(chosen: Preset, source: DrawnFrames, out: Path, *, ranks: Ranks, device: str) -> None:
    """One of the runs."""
    torch.set_num_threads(1)
    torch.manual_seed(5)
    detector = StereoDetector(chosen)
    frames = MixedFrames([source], [1], maker=SampleMaker(chosen, plain_priors(chosen)), seed=2)  # type: ignore[list-item]
    seen: dict[str, np.ndarray] = {}

    def keep(step: int, losses: dict[str, float]) -> None:
        for name, value in losses.items():
            seen[f"loss/{step}/{name}"] = np.array(value)
        for name, parameter in detector.named_parameters():
            if parameter.grad is not None:
                seen[f"gradient/{step}/{name}"] = parameter.grad.numpy().copy()
            seen[f"parameter/{step}/{name}"] = parameter.detach().numpy().copy()

    settings = RunSettings(
        STEPS,
        BATCH,
        1e-3,
        1e-4,
        warmup_steps=0,
        workers=0,
        device=device,
        mixed_precision=False,
        log_every=1,
        freeze_norms=True,
    )
    train(detector, chosen, frames, settings=settings, run_dir=out, resume=False, on_step=keep, ranks=ranks)
    np.savez(out / f"result-{ranks.rank}-of-{ranks.count}.npz", **seen)


if __name__ == "__main__":
    run(Path(sys.argv[1]))
