"""``edge export``: a checkpoint to a finished model directory, checked against torch."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Optional

import typer

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from runtime.contracts.manifest import Manifest
    from runtime.sources.base import FrameSequence

DEFAULT_FRAMES = 3


class InputType(StrEnum):
    """What the graph takes: camera pixels, or pixels normalised outside."""

    UINT8 = "uint8"
    FLOAT32 = "float32"


def export_command(
    checkpoint: Annotated[Path, typer.Option(help="Weights: .safetensors of `edge train`, or a .pt/.pth.")],
    out: Annotated[Path, typer.Option(help="Model directory to write; an older one there is replaced.")],
    preset: Annotated[
        str, typer.Option(help="compact, paper or mono; widths of an official checkpoint are read from its shapes.")
    ] = "compact",
    priors: Annotated[
        Optional[Path],  # noqa: UP045 - typer reads this form
        typer.Option(
            help="Priors file, or folder of it or of the official tables; default: beside the checkpoint, else KITTI's "
            "for paper and mono on its rig."
        ),
    ] = None,
    confidence: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="File of `edge confidence`; default: WEIGHTS-confidence.json beside the checkpoint, if any."),
    ] = None,
    ablate: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(help="Ablation that the weights were trained with, see docs/paper.md; give it again for more."),
    ] = None,
    classes: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Names in channel order, comma-separated, where they are not the preset's."),
    ] = None,
    input_type: Annotated[
        InputType, typer.Option("--input", help="Whether the graph normalises (uint8) or the caller (float32).")
    ] = InputType.UINT8,
    vote: Annotated[
        Optional[float],  # noqa: UP045
        typer.Option(
            min=0.0,
            max=1.0,
            help="Each box becomes the mean of those of its class that overlap it by more than this: steadier in 8 "
            "bits. compact votes from 0.7 on, paper and mono do not.",
        ),
    ] = None,
    source: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Frames to compare torch and ONNX Runtime on; default: the bundled recording."),
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="How many of them.")] = DEFAULT_FRAMES,
) -> None:
    """Export a checkpoint; exit 1 where ONNX Runtime does not give what torch gives."""
    import dataclasses

    import torch
    from rich.console import Console
    from torch import nn

    from edge.detector.ablations import ablated
    from edge.detector.build import build_detector
    from edge.detector.checkpoint_file import read_checkpoint
    from edge.detector.official_shapes import class_count, fitted_preset
    from edge.detector.presets import preset as find_preset
    from edge.detector.weights import check_ablations, check_priors, load_weights
    from edge.samples import calibration_source
    from edge.training.methods import with_method_of
    from edge.training.rig import with_rig_of
    from edge.zoo.card import model_card
    from edge.zoo.priors import BUNDLED_ORIGIN, find_priors, official_classes, uses_bundled_priors
    from export.package import write_model_directory
    from export.parity import measure_parity
    from export.to_onnx import to_onnx
    from export.views import FromPixels
    from runtime.contracts.confidence import read_confidence
    from runtime.contracts.errors import EdgeError, GoalMissedError
    from runtime.contracts.manifest import file_sha256
    from runtime.model_folder import check_place
    from runtime.native.library import library_path
    from runtime.refinement import check_confidence
    from runtime.sources.factory import open_sequence

    check_place(out)
    console = Console(stderr=True, highlight=False)
    weights = read_checkpoint(checkpoint)
    named = with_rig_of(with_method_of(ablated(find_preset(preset), ablate or []), checkpoint), checkpoint)
    names = tuple(name.strip() for name in classes.split(",")) if classes else None
    if names is None and class_count(named, weights) != len(named.classes):
        by_priors = official_classes(priors or checkpoint.parent)
        if len(by_priors) == class_count(named, weights):
            names = by_priors
            console.print(f"classes by the files of the priors: {', '.join(names)}")
    chosen = fitted_preset(named, weights, names)
    check_ablations(checkpoint, chosen)
    manifest = chosen.manifest(input_type=input_type.value)
    if vote is not None:
        manifest = dataclasses.replace(manifest, nms=dataclasses.replace(manifest.nms, voting_iou=vote))
    detector = build_detector(chosen)
    load_weights(detector, weights)
    tables = find_priors(chosen, checkpoint, priors)
    origin = BUNDLED_ORIGIN if uses_bundled_priors(chosen, checkpoint, priors) else None
    if origin is not None:
        console.print(f"priors: {origin}", soft_wrap=True)
    check_priors(checkpoint, tables, chosen.classes)
    beside = checkpoint.with_name(f"{checkpoint.stem}-confidence.json")
    if confidence is None and beside.is_file() and manifest.depth_refinement:
        confidence = beside
        console.print(f"confidence: {beside}", soft_wrap=True, markup=False)
    if confidence is not None and not manifest.depth_refinement:
        raise EdgeError(
            f"--confidence {confidence}: found preset {chosen.name}, expected one whose depths are refined, since "
            "these scores follow from that; leave it out"
        )
    trusted = None if confidence is None else read_confidence(confidence)
    if trusted is not None:
        learned_with = trusted.facts.get("checkpoint_sha256")
        if learned_with not in (None, file_sha256(checkpoint)):
            console.print(
                f"note: {confidence} was learned from boxes of other weights; edge confidence learns it anew",
                soft_wrap=True,
                markup=False,
            )
        check_confidence(trusted.weights, manifest.classes)
        manifest = dataclasses.replace(manifest, confidence=trusted.weights)
    network: nn.Module = detector.eval()
    if input_type is InputType.UINT8:
        network = FromPixels(detector, mean=manifest.normalisation.mean, std=manifest.normalisation.std).eval()
    with open_sequence(source or calibration_source()) as recording:
        feeds = _feeds(recording, manifest, frames)

    with console.status("exporting"):
        examples = {name: torch.from_numpy(array) for name, array in feeds[0].items()}
        model = to_onnx(network, examples, ("cls_logits", "box_deltas"), opset_version=chosen.onnx_opset)
        content = model.SerializeToString()
    with console.status("comparing with torch"):
        report = measure_parity(network, content, feeds)
    lines = report.lines()
    for line in lines:
        console.print(line, soft_wrap=True)
    if library_path() is None:
        console.print("without the native library: build it with python -m runtime.native.build")
    if not report.passed:
        raise GoalMissedError(
            f"parity: found {'; '.join(lines)}; expected at most {report.goal:g}; nothing was written: compare"
            " the layers of the exported graph with the network's"
        )
    provenance = {
        "checkpoint": checkpoint.name,
        "checkpoint_sha256": file_sha256(checkpoint),
        "parity": "; ".join(lines),
    }
    if origin is not None:
        provenance["priors"] = origin
    if trusted is not None:
        provenance |= {f"confidence_{name}": value for name, value in trusted.facts.items()}
    manifest = dataclasses.replace(manifest, provenance=provenance)
    card = model_card(manifest, checkpoint, parity=f"{'; '.join(lines)}.")
    write_model_directory(out, model, manifest, priors=tables, card=card)
    console.print(f"wrote {out}", markup=False)


def _feeds(recording: FrameSequence, manifest: Manifest, count: int) -> list[dict[str, NDArray[Any]]]:
    """The graph's inputs of ``count`` frames spread over a recording."""
    import numpy as np

    from runtime.preprocess import network_view, prepare

    feeds = []
    for index in np.unique(np.linspace(0, len(recording) - 1, count).round().astype(int)):
        frame = recording[int(index)]
        feeds.append(prepare(frame, network_view(frame.geometry, manifest), manifest))
    return feeds
