"""The model directory: ``model.onnx``, ``manifest.json``, ``priors.npz`` (docs/architecture.md).

Unknown keys, another schema and wrong hashes are refused with one line. Nothing here executes what a file says:
JSON and ``.npy`` without pickles are all that is read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import ManifestError

SCHEMA_VERSION = 1
MODEL_FILE = "model.onnx"
MANIFEST_FILE = "manifest.json"
PRIORS_FILE = "priors.npz"
UNUSABLE_MEAN = -100.0
UNUSABLE_STD = 1e10
PRIOR_QUANTITIES = ("z", "sin_2alpha", "cos_2alpha", "width", "height", "length")


@dataclass(frozen=True, slots=True)
class Crop:
    """Which rows of the camera image the network sees.

    Attributes:
        mode: ``top_rows``: drop ``rows`` rows and scale the rest to the network's height, whatever the image;
            ``above_horizon``: begin ``rows`` rows (at ``training_focal_px``) above the principal row and scale to the
            network's focal length, so that any camera shows objects in the size that the network was trained on.
        rows: row count.
        training_focal_px: focal length that ``rows`` is counted at; only for ``above_horizon``.
    """

    mode: Literal["top_rows", "above_horizon"]
    rows: int
    training_focal_px: float | None = None


@dataclass(frozen=True, slots=True)
class Normalisation:
    """RGB statistics; x = (value / 255 - mean) / std."""

    mean: tuple[float, float, float] = (0.485, 0.456, 0.406)
    std: tuple[float, float, float] = (0.229, 0.224, 0.225)


@dataclass(frozen=True, slots=True)
class AnchorLayout:
    """Anchor boxes of every cell: ``size = base_px * 2 ** (i / scales_per_octave)``, width = size / sqrt(ratio),
    height = size * sqrt(ratio); the ratio is the slow index (paper, anchor definition).

    Attributes:
        stride_px: cell size in network pixels.
        base_px: smallest size.
        scales_per_octave: steps a doubling.
        scale_count: sizes a ratio.
        ratios: height over width.
        max_abs_x_m, min_y_m, max_y_m: the ground-plane filter: an anchor stays when, at the mean depth of any class,
            its centre lies within |X| < max_abs_x_m and min_y_m < Y < max_y_m (paper, anchor filtering).
        filter_by_class: the filter asks the class that an anchor is assigned to, or predicts (the paper's rule); else
            any class that passes keeps the anchor for all (the official code's).
        filter_by_ground: False keeps every anchor (ablation).
        depth_by_prior: z = mean + std t with the statistics of the anchor's shape; False: z = 1 / sigmoid(t) - 1 = e^-t
            metres, without them (ablation).
    """

    stride_px: int = 16
    base_px: float = 24.0
    scales_per_octave: float = 4.0
    scale_count: int = 16
    ratios: tuple[float, ...] = (0.5, 1.0, 2.0)
    max_abs_x_m: float = 40.0
    min_y_m: float = -0.5
    max_y_m: float = 1.8
    filter_by_class: bool = False
    filter_by_ground: bool = True
    depth_by_prior: bool = True

    @property
    def per_cell(self) -> int:
        """Anchors in one cell."""
        return self.scale_count * len(self.ratios)


@dataclass(frozen=True, slots=True)
class NmsPolicy:
    """Non-maximum suppression: over all classes together (the official behaviour) or within each class.

    Attributes:
        iou: overlap from which on the lower box is dropped; per_class: only boxes of one class drop each other.
        voting_iou: overlap from which on boxes of the same class have a vote on the kept one (`runtime.voting`); None
            keeps it as it is (official).
        depth_share: boxes of different classes, but for people among themselves, drop each other only where their
            depths differ by less than this share, so that a rider and the car behind both stay; None: wherever they
            overlap (official).
    """

    iou: float = 0.4
    per_class: bool = False
    voting_iou: float | None = None
    depth_share: float | None = None


@dataclass(frozen=True, slots=True)
class Thresholds:
    """Least scores where a command names none: ``evaluate`` for AP, ``display`` for streams and agreement."""

    evaluate: float = 0.05
    display: float = 0.5


@dataclass(frozen=True, slots=True)
class RigLimits:
    """The camera rig of the training data, at network size."""

    focal_px: float
    baseline_m: float


@dataclass(frozen=True, slots=True)
class OperatorVersion:
    """The custom operator domain that the graph uses."""

    domain: str = "edge.stereo"
    version: int = 1


@dataclass(frozen=True, slots=True)
class Manifest:
    """What a model directory says of itself.

    Attributes:
        preset: preset name; classes: names in channel order; input_size_hw: network pixels; input_type: of the graph
        inputs; views: 2 for stereo, 1 for mono; recipe: how the numbers are stored (``float32`` or a quantisation
        recipe's name); hill_climbing, depth_refinement: what happens to boxes after decoding
        (`runtime.hill_climbing`, `runtime.refinement`); confidence: of refined boxes, class to the weights of
        `runtime.refinement.confidence`; sha256: of model.onnx and priors.npz, by file name; tools: versions;
        provenance: free text facts (checkpoint hash, calibration frames, command).
    """

    preset: str
    classes: tuple[str, ...]
    input_size_hw: tuple[int, int]
    input_type: Literal["uint8", "float32"]
    views: Literal[1, 2]
    crop: Crop
    normalisation: Normalisation
    anchors: AnchorLayout
    nms: NmsPolicy
    thresholds: Thresholds
    rig: RigLimits
    recipe: str = "float32"
    hill_climbing: bool = False
    depth_refinement: bool = False
    confidence: dict[str, tuple[float, ...]] = field(default_factory=dict)
    operators: OperatorVersion = field(default_factory=OperatorVersion)
    sha256: dict[str, str] = field(default_factory=dict)
    tools: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, str] = field(default_factory=dict)
    schema_version: int = SCHEMA_VERSION


@dataclass(frozen=True, slots=True)
class AnchorPriors:
    """Statistics of each class by anchor shape (paper, statistical depth priors).

    Attributes:
        mean, std: (classes, scales, ratios, 6) float32; the 6 = z, sin 2a, cos 2a, w, h, l. An unusable cell has
            mean -100 and std 1e10.
    """

    mean: NDArray[np.float32]
    std: NDArray[np.float32]

    def by_anchor(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Mean and std in the order of a cell's anchors (ratio-major): (classes, ratios * scales, 6)."""
        count = self.mean.shape[0]
        return tuple(np.swapaxes(a, 1, 2).reshape(count, -1, 6) for a in (self.mean, self.std))  # type: ignore[return-value]


@dataclass(frozen=True, slots=True)
class ModelDirectory:
    """A verified model directory: its path, manifest and priors."""

    path: Path
    manifest: Manifest
    priors: AnchorPriors

    @property
    def model_path(self) -> Path:
        """The ONNX file."""
        return self.path / MODEL_FILE


def file_sha256(path: Path) -> str:
    """Hex SHA-256 of a file."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def open_model_directory(path: Path | str) -> ModelDirectory:
    """Read and verify a model directory.

    Raises:
        ManifestError: the folder or a file is missing, the manifest is of another schema or has unknown or missing
            keys, a hash differs, the priors have the wrong names or shapes.
    """
    folder = Path(path)
    manifest_path = folder / MANIFEST_FILE
    if not manifest_path.is_file():
        what = "is not a folder" if not folder.is_dir() else f"has no {MANIFEST_FILE}"
        raise ManifestError(
            f"{folder} {what}, expected a model directory; make one with `edge export` or `edge quantize`"
        )
    manifest = parse_manifest(manifest_path.read_text(encoding="utf-8", errors="replace"), where=str(manifest_path))
    for name in (MODEL_FILE, PRIORS_FILE):
        if not (folder / name).is_file():
            raise ManifestError(
                f"{folder} has no {name}, expected it beside {MANIFEST_FILE}; export or copy the model again"
            )
        found, expected = file_sha256(folder / name), manifest.sha256.get(name, "none")
        if found != expected:
            raise ManifestError(
                f"{folder / name} has sha256 {found[:12]}..., the manifest expects {expected[:12]}...; "
                "the file was changed after the manifest was written: export or copy the model again"
            )
    return ModelDirectory(folder, manifest, read_priors(folder / PRIORS_FILE, manifest.classes, manifest.anchors))


def read_priors(path: Path, classes: tuple[str, ...], anchors: AnchorLayout) -> AnchorPriors:
    """Read ``NAME_mean`` and ``NAME_std`` of each class from an ``.npz``.

    Raises:
        ManifestError: the file is no ``.npz`` of plain arrays, or a table is missing or has another shape.
    """
    shape = (anchors.scale_count, len(anchors.ratios), len(PRIOR_QUANTITIES))
    tables: dict[str, NDArray[np.float32]] = {}
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            for name in classes:
                for part in ("mean", "std"):
                    tables[f"{name}_{part}"] = archive[f"{name}_{part}"].astype(np.float32)
    except KeyError as error:
        raise ManifestError(
            f"{path} lacks {error}, expected tables for {', '.join(classes)}; make it with `edge priors`"
        ) from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ManifestError(
            f"{path} is not readable as priors ({type(error).__name__}), expected an .npz; make it anew"
        ) from None
    for name, table in tables.items():
        if table.shape != shape:
            raise ManifestError(f"{path}: {name} has shape {table.shape}, expected {shape}; make it for these anchors")
    return AnchorPriors(
        np.stack([tables[f"{name}_mean"] for name in classes]),
        np.stack([tables[f"{name}_std"] for name in classes]),
    )


def write_priors(path: Path, classes: tuple[str, ...], priors: AnchorPriors) -> None:
    """Write priors as ``NAME_mean``, ``NAME_std`` float32 tables."""
    tables: dict[str, Any] = {}
    for index, name in enumerate(classes):
        tables[f"{name}_mean"] = priors.mean[index].astype(np.float32)
        tables[f"{name}_std"] = priors.std[index].astype(np.float32)
    with path.open("wb") as stream:
        np.savez(stream, **tables)


def format_manifest(manifest: Manifest) -> str:
    """Manifest as JSON text."""
    return json.dumps(dataclasses.asdict(manifest), indent=2) + "\n"


def parse_manifest(text: str, *, where: str = MANIFEST_FILE) -> Manifest:
    """Read a manifest strictly.

    Raises:
        ManifestError: no JSON object, another schema version, unknown or missing keys, a value of the wrong type.
    """
    try:
        data = json.loads(text)
    except json.JSONDecodeError as error:
        raise ManifestError(
            f"{where} is no JSON ({error.msg} at line {error.lineno}), expected a manifest; export again"
        ) from None
    if not isinstance(data, dict):
        raise ManifestError(f"{where} holds a {type(data).__name__}, expected an object; export again")
    version = data.get("schema_version")
    if version != SCHEMA_VERSION:
        raise ManifestError(
            f"{where} has schema version {version!r}, expected {SCHEMA_VERSION}; "
            "export the model again with this version of the package"
        )
    manifest = typing.cast(Manifest, _build(Manifest, data, where))
    if manifest.operators != OperatorVersion():
        raise ManifestError(
            f"{where} uses operators {manifest.operators.domain} version {manifest.operators.version}, "
            f"expected {OperatorVersion().domain} version {OperatorVersion().version}; export the model again"
        )
    return manifest


def _build(kind: Any, value: Any, where: str) -> Any:
    """Build a value of an annotated type from JSON, refusing what does not fit."""
    if dataclasses.is_dataclass(kind):
        if not isinstance(value, dict):
            raise _mismatch(where, value, "an object")
        hints = typing.get_type_hints(kind)
        known = {item.name: item for item in dataclasses.fields(kind)}
        unknown = sorted(set(value) - set(known))
        if unknown:
            raise ManifestError(
                f"{where} has the unknown key {unknown[0]!r}, expected only {', '.join(known)}; export again"
            )
        missing = [
            name
            for name, item in known.items()
            if name not in value and item.default is dataclasses.MISSING and item.default_factory is dataclasses.MISSING
        ]
        if missing:
            raise ManifestError(f"{where} lacks the key {missing[0]!r}, expected {', '.join(known)}; export again")
        made: Any = kind
        return made(**{name: _build(hints[name], item, f"{where}: {name}") for name, item in value.items()})
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        if value not in arguments or isinstance(value, bool):
            raise _mismatch(where, value, f"one of {', '.join(map(str, arguments))}")
        return value
    if origin is types.UnionType:
        return None if value is None else _build(arguments[0], value, where)
    if origin is tuple:
        if not isinstance(value, list) or (arguments[-1] is not Ellipsis and len(value) != len(arguments)):
            raise _mismatch(where, value, f"a list of {'values' if arguments[-1] is Ellipsis else len(arguments)}")
        kinds = [arguments[0]] * len(value) if arguments[-1] is Ellipsis else arguments
        return tuple(_build(item_kind, item, where) for item_kind, item in zip(kinds, value, strict=True))
    if origin is dict:
        if not isinstance(value, dict):
            raise _mismatch(where, value, "an object")
        return {str(key): _build(arguments[1], item, f"{where}: {key}") for key, item in value.items()}
    if kind is float and isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value):
        return float(value)
    if kind is int and isinstance(value, int) and not isinstance(value, bool):
        return value
    if kind in (str, bool) and type(value) is kind:
        return value
    raise _mismatch(where, value, kind.__name__)


def _mismatch(where: str, value: Any, expected: str) -> ManifestError:
    return ManifestError(f"{where} is {json.dumps(value)[:60]}, expected {expected}; export again")
