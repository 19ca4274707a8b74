"""A float model directory to an INT8 one, and what can be wrong with the frames."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("onnx")

from calib.choice_record import read_choice
from quantize.calibration import Calibration, calibrate, choose_frames
from quantize.errors import QuantizeError
from quantize.prepare import int8_share, prepare_model
from quantize.recipe import recipe_for_target
from quantize.sensitivity import layer_noise, own_noise
from quantize.static import build
from quantize.write import write_directory
from runtime.contracts.errors import FrameError, RigError, SourceError
from runtime.contracts.manifest import Normalisation, open_model_directory
from runtime.detector import open_detector
from runtime.sources.factory import open_source

FRAMES = 3
FOCAL_PX = "2.000000000000e+02"
"""Of the tiny drive, as its calibration files write it."""
MIN_LAYER_SNR_DB = 15.0
"""Single layers scatter around the outputs' 25 dB and more; a wrong scale leaves none or negative."""


@pytest.fixture
def cache_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    folder = tmp_path / "cache"
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder


@pytest.fixture
def prepared(toy_directory: Path):
    return prepare_model(open_model_directory(toy_directory), recipe_for_target("x86-vnni"))


def chosen_and_calibrated(prepared, source, wanted, *, use_cache=True, **options) -> Calibration:
    """Both steps that look at frames."""
    choice = choose_frames(prepared, source, wanted, name="drive", use_cache=use_cache, **options)
    return calibrate(prepared, choice, use_cache=use_cache, allow_other_rig=options.get("allow_other_rig", False))


@pytest.fixture
def calibration(prepared, busy_drive: Path, cache_home: Path):
    with open_source(f"kitti-object:{busy_drive}") as source:
        return chosen_and_calibrated(prepared, source, FRAMES)


@pytest.fixture
def busy_drive(tiny_drive: Path) -> Path:
    """The tiny drive with something to see in every picture."""
    import cv2

    random = np.random.default_rng(3)
    for folder in ("image_2", "image_3"):
        for path in sorted((tiny_drive / "training" / folder).iterdir()):
            coarse = random.integers(0, 256, (8, 16, 3)).astype(np.uint8)
            assert cv2.imwrite(str(path), cv2.resize(coarse, (128, 64), interpolation=cv2.INTER_CUBIC))
    return tiny_drive


def test_a_model_directory_comes_out_that_detects(prepared, calibration, toy_directory, busy_drive, tmp_path) -> None:
    (toy_directory / "card.md").write_text("# Toy\n\nData: none.\n", encoding="utf-8")
    out = tmp_path / "made" / "int8"
    graph = build(prepared, calibration.observation, calibration.observation.ranges("mse"))
    written = write_directory(prepared, graph, calibration, out, method="mse")
    assert written.manifest.recipe == "static_wi8_au8_x86_vnni"
    facts = written.manifest.provenance
    assert facts["calibration_frames"].split() == [frame.frame_id for frame in calibration.frames.frames]
    assert read_choice(out).frames == calibration.frames.frames
    assert facts["calibration_pixels_sha256"] == calibration.frames.digest
    assert facts["given_back_to_float"] == "none"
    assert {"onnx", "onnxruntime", "python"} <= set(written.manifest.tools)
    assert (out / "priors.npz").read_bytes() == (toy_directory / "priors.npz").read_bytes()
    card = (out / "card.md").read_text(encoding="utf-8")
    assert card.splitlines()[0] == f"# tiny, {written.manifest.recipe}"  # the title says what this model is
    assert "Data: none." in card  # the rest is the float model's
    assert "## INT8" in card
    assert sorted(path.name for path in out.parent.iterdir()) == ["int8"], "nothing is left beside it"
    assert sorted(path.name for path in out.iterdir()) == [
        *("calibration.json", "card.md", "manifest.json", "model.onnx", "priors.npz")
    ]
    with open_source(f"kitti-object:{busy_drive}") as source, open_detector(out) as detector:
        detections, _ = detector(source[0])
        assert np.isfinite(detections.center_in_camera).all()


def test_the_same_run_gives_the_same_bytes(prepared, calibration) -> None:
    models = [
        build(prepared, calibration.observation, calibration.observation.ranges("percentile")).model for _ in range(2)
    ]
    assert models[0].SerializeToString(deterministic=True) == models[1].SerializeToString(deterministic=True)


def test_the_cache_gives_what_the_run_gave(prepared, busy_drive, cache_home) -> None:
    with open_source(f"kitti-object:{busy_drive}") as source:
        first = chosen_and_calibrated(prepared, source, FRAMES)
        again = chosen_and_calibrated(prepared, source, FRAMES)
        fewer = chosen_and_calibrated(prepared, source, FRAMES - 1)
        without = chosen_and_calibrated(prepared, source, FRAMES, use_cache=False)
    assert [item.from_cache for item in (first, again, fewer, without)] == [False, True, False, False]
    for method in ("minmax", "percentile", "mse", "entropy"):
        assert (
            first.observation.ranges(method) == again.observation.ranges(method) == without.observation.ranges(method)
        )
    for name, (low, high) in first.observation.channels.items():
        np.testing.assert_array_equal(again.observation.channels[name][0], low)
        np.testing.assert_array_equal(again.observation.channels[name][1], high)
    assert not list(cache_home.rglob("*.tmp"))


def test_without_the_cache_nothing_is_written_there(prepared, busy_drive, cache_home) -> None:
    with open_source(f"kitti-object:{busy_drive}") as source:
        chosen_and_calibrated(prepared, source, FRAMES, use_cache=False)
    assert not cache_home.exists()


def test_changed_pixels_miss_the_cache(prepared, busy_drive, cache_home) -> None:
    import cv2

    with open_source(f"kitti-object:{busy_drive}") as source:
        chosen_and_calibrated(prepared, source, FRAMES)
    path = next((busy_drive / "training" / "image_2").iterdir())
    assert cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
    with open_source(f"kitti-object:{busy_drive}") as source:
        assert not chosen_and_calibrated(prepared, source, 4).from_cache


def replace_in_calibration(drive: Path, old: str, new: str) -> None:
    for path in (drive / "training" / "calib").iterdir():
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new), encoding="utf-8")


def test_the_same_pixels_of_another_camera_miss_the_cache(prepared, busy_drive, cache_home) -> None:
    """The camera decides which rows are fed and how they are scaled."""
    with open_source(f"kitti-object:{busy_drive}") as source:
        first = chosen_and_calibrated(prepared, source, FRAMES)
    replace_in_calibration(busy_drive, FOCAL_PX, "2.040000000000e+02")  # within what is tolerated silently
    with open_source(f"kitti-object:{busy_drive}") as source:
        second = chosen_and_calibrated(prepared, source, FRAMES)
    assert first.frames.digest == second.frames.digest
    assert not second.from_cache
    assert len(list(cache_home.glob("*/calibration/*.npz"))) == 2


def test_another_normalisation_misses_the_cache(prepared, busy_drive, cache_home) -> None:
    manifest = dataclasses.replace(
        prepared.source.manifest, normalisation=Normalisation(mean=(0.5, 0.5, 0.5), std=(0.2, 0.2, 0.2))
    )
    other = dataclasses.replace(prepared, source=dataclasses.replace(prepared.source, manifest=manifest))
    with open_source(f"kitti-object:{busy_drive}") as source:
        chosen_and_calibrated(prepared, source, FRAMES)
        assert not chosen_and_calibrated(other, source, FRAMES).from_cache


def test_the_cache_does_not_spare_the_rig_check(prepared, busy_drive, cache_home) -> None:
    replace_in_calibration(busy_drive, FOCAL_PX, "4.000000000000e+02")
    with open_source(f"kitti-object:{busy_drive}") as source:
        told: list[str] = []
        for from_cache in (False, True):
            found = chosen_and_calibrated(prepared, source, 4, allow_other_rig=True, warn=told.append)
            assert found.from_cache is from_cache
        assert [line.partition(":")[0] for line in told] == ["rig", "rig"], "once a run"
        with pytest.raises(RigError, match="focal length"):
            chosen_and_calibrated(prepared, source, 4)


def test_every_layer_is_close_to_its_float_twin(prepared, calibration, toy_feeds) -> None:
    graph = build(prepared, calibration.observation, calibration.observation.ranges("minmax"))
    noise = layer_noise(prepared, graph, lambda: toy_feeds[:2])
    assert {item.node for item in noise} == set(prepared.products)
    assert min(item.snr_db for item in noise) > MIN_LAYER_SNR_DB
    assert sum(item.multiply_adds for item in noise) == sum(prepared.products.values())


def test_the_layer_made_worst_is_ranked_worst(prepared, calibration, toy_feeds) -> None:
    """Ranges of one tensor a hundred times too wide: the layer behind it causes the noise."""
    tensor = prepared.placement.outputs["stereo"][0]
    statistics = calibration.observation.tensors[tensor]
    wide = dataclasses.replace(statistics, maximum=100 * statistics.maximum)
    spoilt = dataclasses.replace(calibration.observation, tensors={**calibration.observation.tensors, tensor: wide})
    ranked = own_noise(prepared, spoilt, spoilt.ranges("minmax"), toy_feeds[:1])
    assert ranked[0].node == "stereo"
    assert [item.snr_db for item in ranked] == sorted(item.snr_db for item in ranked)


def test_frames_whose_names_hold_spaces_are_counted_once(prepared, calibration, toy_directory, tmp_path) -> None:
    frames = tuple(
        dataclasses.replace(frame, frame_id=f"left view {frame.frame_id}") for frame in calibration.frames.frames
    )
    spaced = dataclasses.replace(calibration, frames=dataclasses.replace(calibration.frames, frames=frames))
    graph = build(prepared, spaced.observation, spaced.observation.ranges("mse"))
    written = write_directory(prepared, graph, spaced, tmp_path / "int8", method="mse")
    assert f"from {len(frames)} frames of" in (written.path / "card.md").read_text(encoding="utf-8")


def test_share_of_multiply_adds(prepared) -> None:
    assert int8_share(prepared) == 1.0
    costs = prepared.products
    rest = int8_share(prepared, ["stem", "volume"])
    assert rest == pytest.approx(1 - (costs["stem"] + costs["volume"]) / sum(costs.values()))


def test_a_quantised_model_is_refused(prepared, calibration, tmp_path) -> None:
    graph = build(prepared, calibration.observation, calibration.observation.ranges("mse"))
    written = write_directory(prepared, graph, calibration, tmp_path / "int8", method="mse")
    with pytest.raises(QuantizeError, match="float32"):
        prepare_model(written, prepared.recipe)


def test_a_model_without_convolutions_is_refused(tiny_model) -> None:
    with pytest.raises(QuantizeError, match="with constant weights"):
        prepare_model(open_model_directory(tiny_model), recipe_for_target("x86-vnni"))


def test_the_float_model_is_not_overwritten(prepared, calibration, toy_directory) -> None:
    graph = build(prepared, calibration.observation, calibration.observation.ranges("mse"))
    before = (toy_directory / "model.onnx").read_bytes()
    with pytest.raises(QuantizeError, match="another place"):
        write_directory(prepared, graph, calibration, toy_directory, method="mse")
    assert (toy_directory / "model.onnx").read_bytes() == before


def test_frames_of_another_rig_are_refused(prepared, busy_drive, cache_home) -> None:
    replace_in_calibration(busy_drive, FOCAL_PX, "4.000000000000e+02")
    with open_source(f"kitti-object:{busy_drive}") as source, pytest.raises(RigError, match="focal length"):
        chosen_and_calibrated(prepared, source, FRAMES)


def test_no_frames_and_one_view_are_refused(prepared, busy_drive, cache_home) -> None:
    with pytest.raises(SourceError, match="found no frames"):
        chosen_and_calibrated(prepared, [], FRAMES)
    with (
        open_source(f"kitti-object:{busy_drive}?views=left") as source,
        pytest.raises(FrameError, match="no right image"),
    ):
        chosen_and_calibrated(prepared, source, FRAMES)


def test_fewer_frames_than_wanted_are_said(prepared, busy_drive, cache_home) -> None:
    told: list[str] = []
    with open_source(f"kitti-object:{busy_drive}") as source:
        calibration = chosen_and_calibrated(prepared, source, 100, warn=told.append)
    assert len(calibration.frames.frames) == 4
    assert any("4 frames, 100 were wanted" in line for line in told)
