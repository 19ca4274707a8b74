"""A float model directory to an INT8 one, in three steps that can be repeated on their own.

`prepare_model` reads the model and places the recipe on it; `calibrate` runs it over frames, or finds in
the cache what such a run saw; `build` writes the INT8 graph for any set of nodes given back to float,
without running anything. So a search over placements calibrates once. `write_directory` puts the result
where the user wants it.
"""

from __future__ import annotations

import dataclasses
import platform
import re
import shutil
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np
import onnx

from calib.cache import cache_key, load, store
from calib.frames import CalibrationSet, chosen_frames, frame_feeds, record, rig_check
from calib.methods import Range
from calib.ranges import Observation, Progress, no_progress, observe
from quantize.bias_correction import Shifts, bias_shifts
from quantize.equalise import equalisable, equalise
from quantize.errors import QuantizeError
from quantize.graph import multiply_adds, name_nodes, tensor_shapes
from quantize.pixels import fold_pixels
from quantize.placement import PRODUCTS, Placement, place
from quantize.qdq import QuantisedGraph, quantise_graph
from quantize.recipe import FLOAT_RECIPE, Recipe
from runtime.contracts.frame import StereoFrame
from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    Manifest,
    ModelDirectory,
    file_sha256,
    format_manifest,
    open_model_directory,
)
from runtime.model_folder import replaced_directory

CARD_FILE = "card.md"
_TOOLS = ("onnx", "onnxruntime", "numpy")
_FLOAT_BYTES = 4
CORRECTION_FRAMES = 8
"""Frames that show bias correction its means, and equalisation its channels' peaks."""


@dataclass(frozen=True, slots=True)
class Prepared:
    """A float model, ready to be calibrated.

    Attributes:
        source: its directory.
        recipe: how it is going to be quantised.
        model: the graph, pixels folded, nodes named.
        placement: where 8 bits go when nothing is given back.
        shapes: of the graph's tensors.
        pixel_note: why pixels were not folded; None where they were or should not be.
    """

    source: ModelDirectory
    recipe: Recipe
    model: onnx.ModelProto
    placement: Placement
    shapes: dict[str, tuple[int, ...]]
    pixel_note: str | None

    @property
    def products(self) -> dict[str, int]:
        """Multiply-adds of each node that has any, by name, in the order of the graph."""
        costs = {node.name: multiply_adds(node, self.shapes) for node in self.model.graph.node}
        return {name: cost for name, cost in costs.items() if cost > 0}


@dataclass(frozen=True, slots=True)
class Calibration:
    """What was seen on which frames.

    Attributes:
        frames: the record of the choice.
        observation: statistics by tensor.
        from_cache: whether the model had been run over these frames before.
    """

    frames: CalibrationSet
    observation: Observation
    from_cache: bool


def prepare_model(directory: ModelDirectory, recipe: Recipe) -> Prepared:
    """Reads a float model and places a recipe on it.

    Raises:
        QuantizeError: The model is quantised already, or nothing in it can be.
    """
    if directory.manifest.recipe != FLOAT_RECIPE:
        raise QuantizeError(
            f"{directory.path}: found a model of recipe {directory.manifest.recipe}; expected a {FLOAT_RECIPE} one; "
            "give the directory that `edge export` wrote"
        )
    model = onnx.load(directory.model_path)
    name_nodes(model)
    note = None
    if recipe.fold_pixels:
        folding = fold_pixels(model)
        model, note = folding.model, folding.reason
    placement = place(model, recipe)
    if not any(_is_product(node) for node in model.graph.node if node.name in placement.nodes):
        raise QuantizeError(
            f"{directory.path}: found no operator of {', '.join(sorted(PRODUCTS))} with constant weights; expected "
            "one or more; export the model again"
        )
    return Prepared(directory, recipe, model, placement, tensor_shapes(model), note)


def calibrate(
    prepared: Prepared,
    source: Iterable[StereoFrame],
    wanted: int,
    *,
    name: str,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
    warn: Callable[[str], None] = lambda line: None,
) -> Calibration:
    """Chooses frames of an entered source and takes the statistics of all 8-bit tensors on them.

    Args:
        prepared: The model.
        source: Calibration frames.
        wanted: How many of them.
        name: What the record calls the source.
        use_cache: Look for, and keep, the statistics in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told how far it is.
        warn: Told in one line what is odd about the frames.

    Raises:
        SourceError: There are no frames.
        RigError, FrameError: A frame does not fit the model.
        FormatError: The float model gives values that are not finite.
    """
    manifest, placement = prepared.source.manifest, prepared.placement
    check = rig_check(manifest, allow_other_rig=allow_other_rig, warn=warn)
    chosen = record(source, wanted, name=name, check=check)
    if chosen.available is not None and chosen.available < wanted:
        warn(f"calibration source: {chosen.available} frames, {wanted} were wanted; all are used")
    key = _key(
        prepared,
        prepared.model,
        chosen,
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
    )
    known = load(key) if use_cache else None
    if known is not None:
        return Calibration(chosen, known, from_cache=True)
    observation = observe(
        prepared.model,
        lambda: frame_feeds(chosen_frames(source, wanted), manifest, allow_other_rig=allow_other_rig),
        tensors=placement.observed,
        channel_tensors=placement.observed_channels,
        bytes_of={tensor: _size(shape) * _FLOAT_BYTES for tensor, shape in prepared.shapes.items()},
        frame_count=len(chosen.frames),
        progress=progress,
    )
    if use_cache:
        store(key, observation)
    return Calibration(chosen, observation, from_cache=False)


def build(
    prepared: Prepared,
    observation: Observation,
    ranges: Mapping[str, Range],
    *,
    given_back: Collection[str] = (),
    shifts: Shifts | None = None,
) -> QuantisedGraph:
    """Writes the INT8 graph.

    Args:
        prepared: The float model.
        observation: Of its whole placement.
        ranges: ``observation.ranges(method)``, made once for many builds.
        given_back: Names of nodes that stay float.
        shifts: What biases take in addition (`corrections`); None for nothing.
    """
    placement = place(prepared.model, prepared.recipe, given_back) if given_back else prepared.placement
    # A tensor can be a root only since the move that made it was given back: it had its root's range before.
    known = {name: ranges[prepared.placement.root_of.get(name, name)] for name in placement.observed}
    return quantise_graph(
        prepared.model, placement, prepared.recipe, ranges=known, channels=observation.channels, shifts=shifts
    )


def equalised(
    prepared: Prepared,
    source: Iterable[StereoFrame],
    *,
    wanted: int,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Prepared:
    """The same network with channels of like range; as it was where the recipe does not equalise.

    Comes before `calibrate`, which then sees the ranges of the new channels.

    Args:
        prepared: The float model.
        source: Entered calibration frames.
        wanted: How many of them calibrate; a few of those show how large channels get.
        use_cache: Look for, and keep, what they showed in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.

    Raises:
        SourceError, RigError, FrameError, FormatError: As `calibrate`.
    """
    names = (
        equalisable(prepared.model, prepared.shapes, prepared.placement.observed) if prepared.recipe.equalise else []
    )
    if not names:
        return prepared
    manifest = prepared.source.manifest
    check = rig_check(manifest, allow_other_rig=allow_other_rig)
    chosen = record(source, wanted, few=CORRECTION_FRAMES, name="", check=check)
    key = _key(prepared, prepared.model, chosen, tensors=(), channel_tensors=names)
    seen = load(key) if use_cache else None
    if seen is None:
        seen = observe(
            prepared.model,
            lambda: frame_feeds(
                chosen_frames(source, wanted, CORRECTION_FRAMES), manifest, allow_other_rig=allow_other_rig
            ),
            tensors=(),
            channel_tensors=names,
            bytes_of={tensor: _size(shape) * _FLOAT_BYTES for tensor, shape in prepared.shapes.items()},
            frame_count=len(chosen.frames),
            progress=lambda stage, done, total: progress("looking at channels", done, total),
        )
        if use_cache:
            store(key, seen)
    return dataclasses.replace(prepared, model=equalise(prepared.model, prepared.shapes, seen.channels))


def corrections(
    prepared: Prepared,
    calibration: Calibration,
    ranges: Mapping[str, Range],
    source: Iterable[StereoFrame],
    *,
    wanted: int,
    use_cache: bool = True,
    allow_other_rig: bool = False,
    progress: Progress = no_progress,
) -> Shifts:
    """What the biases take in addition on account of 8 bits; nothing where the recipe does not correct.

    Args:
        prepared: The float model.
        calibration: Of its whole placement.
        ranges: Of its tensors, those that the build will use.
        source: Entered calibration frames.
        wanted: How many of them calibrate; a few of those are run, since means settle soon.
        use_cache: Look for, and keep, the result in the user's cache folder.
        allow_other_rig: Accept cameras far from those of the training data.
        progress: Told after every frame.
    """
    if not prepared.recipe.bias_correction:
        return {}
    graph = build(prepared, calibration.observation, ranges)
    key = _key(prepared, graph.model, calibration.frames, tensors=("bias shifts", str(CORRECTION_FRAMES)))
    seen = load(key) if use_cache else None
    if seen is not None:
        return {name: shift.astype(np.float64) for name, (shift, _) in seen.channels.items()}
    feeds = frame_feeds(
        chosen_frames(source, wanted, CORRECTION_FRAMES), prepared.source.manifest, allow_other_rig=allow_other_rig
    )
    found = bias_shifts(
        prepared.model, graph.model, prepared.placement, feeds, frame_count=CORRECTION_FRAMES, progress=progress
    )
    rounded = {name: shift.astype(np.float32) for name, shift in found.items()}
    if use_cache:
        store(key, Observation({}, {name: (shift, shift) for name, shift in rounded.items()}, CORRECTION_FRAMES))
    return {name: shift.astype(np.float64) for name, shift in rounded.items()}


def _key(
    prepared: Prepared,
    model: onnx.ModelProto,
    frames: CalibrationSet,
    *,
    tensors: Sequence[str],
    channel_tensors: Sequence[str] = (),
) -> str:
    """Hash of all that a run over frames depends on."""
    manifest = prepared.source.manifest
    return cache_key(
        model.SerializeToString(deterministic=True),
        frames.digest,
        geometry_digest=frames.geometry_digest,
        tensors=tensors,
        channel_tensors=channel_tensors,
        view=repr((manifest.crop, manifest.input_size_hw, manifest.input_type, manifest.normalisation, manifest.rig)),
    )


def int8_share(prepared: Prepared, given_back: Collection[str] = ()) -> float:
    """Share of the multiply-adds that compute in 8 bits, correlations included; 0 to 1."""
    nodes = place(prepared.model, prepared.recipe, given_back).nodes
    in_8_bits = set(nodes)
    if not prepared.recipe.quantize_correlation:
        in_8_bits -= {node.name for node in prepared.model.graph.node if node.op_type == "StereoCorrelation"}
    costs = prepared.products
    return sum(cost for name, cost in costs.items() if name in in_8_bits) / max(sum(costs.values()), 1)


def write_directory(
    prepared: Prepared,
    graph: QuantisedGraph,
    calibration: Calibration,
    out: Path,
    *,
    method: str,
    given_back: Collection[str] = (),
) -> ModelDirectory:
    """Writes the INT8 model directory: graph, manifest, priors as they were, card with what was done.

    Raises:
        QuantizeError: ``out`` is the directory of the float model.
        OutputError: The place is taken or cannot be written.
    """
    source = prepared.source
    if out.resolve() == source.path.resolve():
        raise QuantizeError(
            f"--out: found the float model's own directory {out}; expected another; choose another place"
        )
    onnx.checker.check_model(graph.model)
    with replaced_directory(out) as folder:
        onnx.save(graph.model, folder / MODEL_FILE)
        shutil.copyfile(source.path / PRIORS_FILE, folder / PRIORS_FILE)
        manifest = _manifest(prepared, calibration, folder, method=method, given_back=given_back)
        (folder / MANIFEST_FILE).write_text(format_manifest(manifest), encoding="utf-8")
        (folder / CARD_FILE).write_text(_card(source.path, manifest), encoding="utf-8")
    return open_model_directory(out)


def _manifest(
    prepared: Prepared,
    calibration: Calibration,
    folder: Path,
    *,
    method: str,
    given_back: Collection[str],
) -> Manifest:
    old, frames = prepared.source.manifest, calibration.frames
    provenance = {
        **old.provenance,
        "float_model_sha256": old.sha256[MODEL_FILE],
        "int8_target": prepared.recipe.target,
        "int8_range_method": method,
        "calibration_source": frames.source,
        "calibration_frames": " ".join(frame.frame_id for frame in frames.frames),
        "calibration_pixels_sha256": frames.digest,
        "given_back_to_float": " ".join(sorted(given_back)) or "none",
    }
    tools = {**old.tools, "python": platform.python_version(), **{name: version(name) for name in _TOOLS}}
    return dataclasses.replace(
        old,
        recipe=prepared.recipe.name,
        sha256={name: file_sha256(folder / name) for name in (MODEL_FILE, PRIORS_FILE)},
        tools=tools,
        provenance=provenance,
    )


def _card(source: Path, manifest: Manifest) -> str:
    """The float model's card with a section on INT8."""
    path = source / CARD_FILE
    before = path.read_text(encoding="utf-8").rstrip() if path.is_file() else f"# {manifest.preset}"
    before = re.sub(r"^# .*", f"# {manifest.preset}, {manifest.recipe}", before, count=1)
    facts = manifest.provenance
    count = len(facts["calibration_frames"].split())
    return (
        f"{before}\n\n## INT8\n\n"
        f"Recipe `{manifest.recipe}` for {facts['int8_target']}; ranges by {facts['int8_range_method']} from {count} "
        f"frames of `{facts['calibration_source']}` (pixels {facts['calibration_pixels_sha256'][:12]}).\n"
        f"Layers given back to float: {facts['given_back_to_float']}.\n"
        "The ranges are learned from the calibration frames; the licence of those frames goes with them.\n"
    )


def _is_product(node: onnx.NodeProto) -> bool:
    return node.op_type in PRODUCTS


def _size(shape: tuple[int, ...]) -> int:
    size = 1
    for extent in shape:
        size *= extent
    return size
