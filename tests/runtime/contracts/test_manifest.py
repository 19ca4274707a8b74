"""The model directory: what it must hold, and every way to be wrong."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge.detector.presets import PRESETS, preset
from runtime.contracts.errors import ManifestError
from runtime.contracts.manifest import (
    MANIFEST_FILE,
    MODEL_FILE,
    PRIORS_FILE,
    AnchorPriors,
    file_sha256,
    format_manifest,
    open_model_directory,
    parse_manifest,
    read_priors,
    write_priors,
)


def plain_priors(name: str = "compact") -> AnchorPriors:
    chosen = preset(name)
    shape = (len(chosen.classes), chosen.anchors.scale_count, len(chosen.anchors.ratios), 6)
    values = np.arange(np.prod(shape), dtype=np.float32).reshape(shape)
    return AnchorPriors(values, values + 1)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    out = tmp_path / "model"
    out.mkdir()
    chosen = preset("compact")
    (out / MODEL_FILE).write_bytes(b"graph")
    write_priors(out / PRIORS_FILE, chosen.classes, plain_priors())
    hashes = {name: file_sha256(out / name) for name in (MODEL_FILE, PRIORS_FILE)}
    (out / MANIFEST_FILE).write_text(format_manifest(dataclasses.replace(chosen.manifest(), sha256=hashes)))
    return out


@pytest.mark.parametrize("name", PRESETS)
def test_manifest_round_trip(name: str) -> None:
    manifest = preset(name).manifest(input_type="float32")
    assert parse_manifest(format_manifest(manifest)) == manifest


def test_directory_round_trip(folder: Path) -> None:
    opened = open_model_directory(folder)
    assert opened.manifest.preset == "compact"
    np.testing.assert_array_equal(opened.priors.std, plain_priors().std)


def test_priors_follow_the_anchor_order() -> None:
    mean, _ = plain_priors().by_anchor()
    scales = preset("compact").anchors.scale_count
    # anchor 1 of a cell is the second scale of the first ratio
    np.testing.assert_array_equal(mean[0, 1], plain_priors().mean[0, 1, 0])
    np.testing.assert_array_equal(mean[0, scales], plain_priors().mean[0, 0, 1])


@pytest.mark.parametrize("name", [MODEL_FILE, PRIORS_FILE, MANIFEST_FILE])
def test_missing_file(folder: Path, name: str) -> None:
    (folder / name).unlink()
    with pytest.raises(ManifestError, match=f"has no {name}"):
        open_model_directory(folder)


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(ManifestError, match="is not a folder"):
        open_model_directory(tmp_path / "nothing")


@pytest.mark.parametrize("name", [MODEL_FILE, PRIORS_FILE])
def test_changed_file(folder: Path, name: str) -> None:
    with (folder / name).open("ab") as stream:
        stream.write(b"x")
    with pytest.raises(ManifestError, match="changed after the manifest"):
        open_model_directory(folder)


def _set(*path: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        for key in path[:-1]:
            data = data[key]
        data[path[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_set("schema_version", value=99), "schema version 99"),
        (_set("colour", value="red"), "unknown key 'colour'"),
        (_set("crop", "colour", value=1), "unknown key 'colour'"),
        (lambda data: data.pop("classes"), "lacks the key 'classes'"),
        (_set("classes", value="Car"), "expected a list"),
        (_set("classes", value=[1]), "expected str"),
        (_set("input_size_hw", value=[192]), "expected a list of 2"),
        (_set("input_size_hw", value=[192, 896.5]), "expected int"),
        (_set("input_type", value="int4"), "one of uint8, float32"),
        (_set("views", value=True), "one of 1, 2"),
        (_set("crop", value=[]), "expected an object"),
        (_set("nms", "iou", value="big"), "expected float"),
        (_set("nms", "per_class", value=1), "expected bool"),
        (_set("sha256", value=[]), "expected an object"),
        (_set("operators", "version", value=2), "edge.stereo version 2"),
    ],
)
def test_malformed_manifest(change: Callable[[dict[str, Any]], None], message: str) -> None:
    data = json.loads(format_manifest(preset("compact").manifest()))
    change(data)
    with pytest.raises(ManifestError, match=message) as caught:
        parse_manifest(json.dumps(data))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "3", "\x00\x01"])
def test_no_manifest_at_all(text: str) -> None:
    with pytest.raises(ManifestError):
        parse_manifest(text)


def test_priors_of_other_shape_or_kind(tmp_path: Path) -> None:
    chosen = preset("compact")
    file = tmp_path / PRIORS_FILE
    write_priors(file, chosen.classes, plain_priors())
    with pytest.raises(ManifestError, match="has shape"):
        read_priors(file, chosen.classes, preset("paper").anchors)
    with pytest.raises(ManifestError, match="lacks"):
        read_priors(file, ("Tram",), chosen.anchors)
    file.write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(ManifestError, match="not readable"):
        read_priors(file, chosen.classes, chosen.anchors)
    np.savez(file, Car_mean=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ManifestError):
        read_priors(file, ("Car",), chosen.anchors)
