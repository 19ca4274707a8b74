"""What a run needs before its first step: a folder, priors, a length."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import torch

from edge.detector.presets import Preset
from edge.training.checkpoint import CHECKPOINT_FILE, load_checkpoint, load_hold
from edge.training.labelled_views import labelled_views
from edge.training.priors import anchor_statistics
from edge.training.run_record import SETTINGS_FILE
from edge.training.schedule import steps_of
from edge.zoo.priors import bundled_priors
from runtime.contracts.errors import CheckpointError, EdgeError, OutputError
from runtime.contracts.manifest import PRIORS_FILE, AnchorPriors, file_sha256, read_priors, write_priors
from runtime.model_folder import CARD_FILE
from runtime.sources.base import FrameSequence

UNKEPT_PRIORS_FILE = f"{PRIORS_FILE}.part"
DEFAULT_STEPS = 10000


def check_device(device: str) -> None:
    """Refuse a GPU that is not there.

    Raises:
        EdgeError: another word than cpu or cuda, or CUDA without a GPU.
    """
    kind, of_several, number = device.partition(":")
    if device != "cpu" and kind != "cuda":
        raise EdgeError(f"--device is {device!r}, expected cpu or cuda; choose one")
    if kind == "cuda" and not torch.cuda.is_available():
        raise EdgeError("--device cuda finds no GPU, expected one with a CUDA build of torch; use --device cpu")
    if of_several and not (number.isdecimal() and int(number) < torch.cuda.device_count()):
        raise EdgeError(
            f"--device is {device!r}, expected cuda:N with N below {torch.cuda.device_count()}, the number of GPUs; "
            "choose one"
        )


def check_unlabelled(preset: Preset, uris: Sequence[str]) -> None:
    """Refuse frames that teach disparity alone where nothing learns disparity, or that cannot be read in any order.

    Raises:
        EdgeError: the preset is mono, or an ablation took its disparity supervision away; or a source is a video.
    """
    videos = [uri for uri in uris if uri.startswith("video:")]
    if videos:
        raise EdgeError(
            f"--unlabelled {videos[0]} is a video, expected images, since training reads frames in any order; write "
            "its frames as images and name these"
        )
    if uris and (preset.views == 1 or preset.training.disparity_source == "none"):
        raise EdgeError(
            f"--unlabelled {uris[0]} with preset {preset.name}, which learns no disparity, expected one that does; "
            "leave it out"
        )


def open_run(out: Path, *, resume: bool, before_cooldown: bool = False) -> int:
    """Make the run's folder, or look into it. What a start that failed left there is taken away by a new run.

    Args:
        out: the folder.
        resume: go on from its checkpoint.
        before_cooldown: from the one before its cooldown, which `edge.training.checkpoint.back_to_hold` makes its own.

    Returns:
        The step that the run goes on from.

    Raises:
        OutputError: the folder holds something and the run is new, or it cannot be made.
        CheckpointError: ``resume`` without a checkpoint, ``before_cooldown`` without one from before it.
        EdgeError: ``before_cooldown`` without ``resume``.
    """
    if before_cooldown and not resume:
        raise EdgeError("--before-cooldown goes on with a run that there is, expected --resume beside it; add it")
    if before_cooldown:
        return int(load_hold(out)["step"])
    if resume:
        return int(load_checkpoint(out / CHECKPOINT_FILE)["step"])
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{out} cannot be made ({error.strerror}), expected a place for a run directory; choose another --out"
        ) from None
    found = {item.name for item in out.iterdir()}
    if not found <= _left_by_a_failed_start(found):
        remedy = "choose another --out" + (" or add --resume" if CHECKPOINT_FILE in found else "")
        raise OutputError(f"{out} is not empty, expected a new run directory; {remedy}")
    for name in found:
        (out / name).unlink()
    return 0


def _left_by_a_failed_start(found: set[str]) -> set[str]:
    """What a run may begin anew over; priors or a card may be somebody's own, but beside ``run.json`` they are its."""
    return {UNKEPT_PRIORS_FILE, SETTINGS_FILE, *([PRIORS_FILE, CARD_FILE] if SETTINGS_FILE in found else [])}


def run_priors(out: Path, preset: Preset, sources: Sequence[FrameSequence], *, given: Path | None) -> AnchorPriors:
    """The run's anchor priors: those in its folder, the given ones, the bundled ones, or the datasets' labels'.

    Presets paper and mono come with the statistics of KITTI's train split, see `edge.zoo.priors`. New ones lie in the
    folder as ``priors.npz.part`` until `keep_priors`, so that a start that fails leaves nothing that looks like a run.

    Raises:
        CheckpointError: the given ones are not those that the run began with.
        ManifestError: the given ones do not fit the preset.
    """
    file = out / PRIORS_FILE
    if given is not None and file.exists() and file_sha256(given) != file_sha256(file):
        raise CheckpointError(f"{given} are not the priors of the run in {out}, expected the same; leave --priors out")
    given = bundled_priors(preset) if given is None else given
    if not file.exists():
        file = out / UNKEPT_PRIORS_FILE
    if not file.exists():
        if given is not None:
            read_priors(given, preset.classes, preset.anchors)
            shutil.copyfile(given, file)
        else:
            views = (view for source in sources for view in labelled_views(source, preset))
            tables = anchor_statistics(views, preset.classes, preset.anchors, input_size_hw=preset.input_size_hw)
            write_priors(file, preset.classes, tables)
    return read_priors(file, preset.classes, preset.anchors)


def keep_priors(out: Path) -> None:
    """Give the run's priors their name: all else that a run needs is there."""
    if (out / UNKEPT_PRIORS_FILE).exists():
        (out / UNKEPT_PRIORS_FILE).replace(out / PRIORS_FILE)


def run_steps(
    preset: Preset,
    *,
    steps: int | None,
    epochs: int | None,
    epoch_samples: int,
    batch_size: int,
    before: int | None = None,
    done: int = 0,
) -> int:
    """Length of the run: what was asked for, else what it was before, else the preset's epochs or `DEFAULT_STEPS`.

    Args:
        preset: to train.
        steps, epochs: what was asked for.
        epoch_samples, batch_size: what makes epochs steps.
        before: length of the run that is resumed.
        done: steps of it.

    Raises:
        EdgeError: both were asked for, or less than is done.
    """
    if steps is not None and epochs is not None:
        raise EdgeError(f"--steps {steps} and --epochs {epochs} both give the length, expected one; leave one out")
    if steps is None and epochs is None:
        steps, epochs = before, preset.training.epochs
    if steps is None and epochs is not None:
        steps = steps_of(epochs, epoch_samples=epoch_samples, batch_size=batch_size)
    steps = DEFAULT_STEPS if steps is None else steps
    if steps < done:
        raise EdgeError(f"a length of {steps} steps, but the run has done {done}, expected at least those; give more")
    return steps
