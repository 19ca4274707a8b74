"""``edge confidence``: learns how far a model's boxes can be believed, from labelled frames."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def confidence_command(
    model: Annotated[Path, typer.Argument(help="Model directory that refines depths (preset compact).")],
    source: Annotated[
        list[str], typer.Option(help="Labelled frames that the weights have not seen; give it again for more.")
    ],
    out: Annotated[Path, typer.Option(help="File to write, .json, for `edge export --confidence`.")],
    classes: Annotated[
        str | None, typer.Option(help="Names, comma-separated; default: those that the frames hold enough of.")
    ] = None,
    allow_other_rig: Annotated[
        bool, typer.Option("--allow-other-rig", help="Accept a camera far from those of the training data.")
    ] = False,
    overwrite: Annotated[bool, typer.Option(help="Replace the file if it is there.")] = False,
) -> None:
    """Learn scores that tell how probable it is that a box is right in 3D."""
    from edge.cli.source_names import public_name
    from edge.cli.stages import warn
    from edge.evaluation.confidence_fit import TooFewBoxesError, fit_confidence
    from edge.report.terminal import progress_bar, report_console
    from runtime.contracts.confidence import ConfidenceRecord, write_confidence
    from runtime.contracts.errors import EdgeError, SourceError
    from runtime.contracts.manifest import MODEL_FILE
    from runtime.detector import open_detector
    from runtime.sinks.places import claim_file
    from runtime.sources.factory import open_sequence

    claim_file(out, overwrite=overwrite)
    found, labels, widths = [], [], []
    with open_detector(model, allow_other_rig=allow_other_rig, warn=warn) as detector:
        known = detector.manifest.classes
        names = list(known) if classes is None else [name.strip() for name in classes.split(",")]
        if not detector.manifest.depth_refinement or not set(names) <= set(known):
            raise EdgeError(
                f"{model} refines no depths or does not know {', '.join(names)}, expected a model that does; "
                "export one of preset compact"
            )
        for uri in source:
            with open_sequence(uri) as frames, progress_bar(f"looking at {public_name(uri)}", len(frames)) as step:
                for index in range(len(frames)):
                    truth = frames.labels(index)
                    if truth is not None:
                        frame = frames[index]
                        found.append(detector.look(frame))
                        labels.append(truth)
                        widths.append(frame.left.shape[1])
                    step()
        if not labels:
            raise SourceError(f"{', '.join(source)}: no frame has labels, expected some; give a labelled source")
        of_model = {"model_sha256": detector.manifest.sha256[MODEL_FILE]}
        if "checkpoint_sha256" in detector.manifest.provenance:
            of_model["checkpoint_sha256"] = detector.manifest.provenance["checkpoint_sha256"]
    fits = []
    for name in names:
        try:
            fit = fit_confidence(found, labels, widths, name)
        except TooFewBoxesError as error:
            if classes is not None or (name == names[-1] and not fits):
                raise
            warn(f"{error}, or {name} keeps the network's score")
            continue
        if fit.loss_after < fit.loss_before:
            fits.append(fit)
        else:
            warn(
                f"{name} keeps the network's score: on frames left out of learning its surprise is "
                f"{fit.loss_before:.3f}, that of what refinement learned {fit.loss_after:.3f}"
            )
    if not fits:
        raise EdgeError(
            f"{model}: found no class whose scores {len(labels)} frames better, expected one; give more labelled frames"
        )
    record = ConfidenceRecord(
        weights={fit.name: fit.weights for fit in fits},
        facts={
            **of_model,
            "frames": str(len(labels)),
            "sources": " ".join(public_name(uri) for uri in source),
            **{f"{fit.name}_boxes": f"{fit.boxes}, {fit.right} of them right" for fit in fits},
        },
    )
    write_confidence(out, record)
    console = report_console()
    for fit in fits:
        console.print(
            f"{fit.name}: {fit.boxes} boxes, {fit.right} right; surprise (mean -log of what was said) "
            f"{fit.loss_before:.3f} by the network's scores, {fit.loss_after:.3f} with what refinement learned",
            soft_wrap=True,
        )
    console.print(f"wrote {out}; hand it to edge export --confidence", soft_wrap=True)
