"""Model directories: whole or not at all, and nothing of the user's is ever overwritten."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from runtime.contracts.errors import OutputError
from runtime.contracts.manifest import (
    AnchorLayout,
    AnchorPriors,
    Crop,
    Manifest,
    NmsPolicy,
    Normalisation,
    RigLimits,
    Thresholds,
    open_model_directory,
)
from runtime.model_folder import replaced_directory

onnx = pytest.importorskip("onnx")
pytest.importorskip("torch")
from export.package import write_model_directory  # noqa: E402

pytestmark = pytest.mark.torch

LAYOUT = AnchorLayout(scale_count=2, ratios=(0.5, 1.0))
PRIORS = AnchorPriors(*(np.full((1, 2, 2, 6), value, np.float32) for value in (3.0, 0.5)))


def a_manifest(preset: str = "compact") -> Manifest:
    return Manifest(
        preset=preset,
        classes=("Car",),
        input_size_hw=(32, 96),
        input_type="uint8",
        views=2,
        crop=Crop("top_rows", 4),
        normalisation=Normalisation(),
        anchors=LAYOUT,
        nms=NmsPolicy(),
        thresholds=Thresholds(),
        rig=RigLimits(500.0, 0.5),
    )


def a_model():  # type: ignore[no-untyped-def]
    info = [onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, (1,)) for name in ("x", "y")]
    graph = onnx.helper.make_graph([onnx.helper.make_node("Relu", ["x"], ["y"])], "relu", info[:1], info[1:])
    return onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 18)], ir_version=10)


def write(out: Path, preset: str = "compact") -> Manifest:
    return write_model_directory(out, a_model(), a_manifest(preset), priors=PRIORS, card="# card\n")


def test_what_is_written_can_be_read(tmp_path: Path) -> None:
    out = tmp_path / "deep" / "model"
    written = write(out)
    assert sorted(path.name for path in out.iterdir()) == ["card.md", "manifest.json", "model.onnx", "priors.npz"]
    assert [path.name for path in out.parent.iterdir()] == ["model"]
    read = open_model_directory(out)
    assert read.manifest == written and set(read.manifest.sha256) == {"model.onnx", "priors.npz"}
    assert read.manifest.tools["onnx"] == onnx.__version__
    np.testing.assert_array_equal(read.priors.mean, PRIORS.mean)


def test_replaces_an_older_model_whole(tmp_path: Path) -> None:
    out = tmp_path / "model"
    write(out)
    (out / "report.md").write_text("of the older one")
    write(out, preset="paper")
    assert open_model_directory(out).manifest.preset == "paper"
    assert not (out / "report.md").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_takes_an_empty_folder(tmp_path: Path) -> None:
    write(tmp_path)
    assert open_model_directory(tmp_path).manifest.preset == "compact"


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_leaves_what_is_not_a_model_alone(tmp_path: Path, kind: str) -> None:
    out = tmp_path / "precious"
    kept = out if kind == "file" else out / "thesis.txt"
    kept.parent.mkdir(exist_ok=True)
    kept.write_text("years of work")
    with pytest.raises(OutputError, match="no model directory"):
        write(out)
    assert kept.read_text() == "years of work"


@pytest.mark.parametrize("foreign", ["other manifest", "own file"])
def test_leaves_folders_that_hold_more_than_a_model(tmp_path: Path, foreign: str) -> None:
    out = tmp_path / "model"
    if foreign == "own file":
        write(out)
        (out / "notes.txt").write_text("mine")
    else:
        out.mkdir()
        (out / "manifest.json").write_text('{"name": "a web application"}')
    before = sorted(path.name for path in out.iterdir())
    with pytest.raises(OutputError, match="no model directory"):
        write(out)
    assert sorted(path.name for path in out.iterdir()) == before


def test_a_failure_on_the_way_leaves_the_older_one(tmp_path: Path) -> None:
    out = tmp_path / "model"
    write(out)
    with pytest.raises(RuntimeError, match="power cut"), replaced_directory(out) as folder:
        (folder / "half").write_text("half")
        raise RuntimeError("power cut")
    assert open_model_directory(out).manifest.preset == "compact"
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_an_unwritable_place_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written") as error:
        write(tmp_path / "file" / "model")
    assert "\n" not in str(error.value)
