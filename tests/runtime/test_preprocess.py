"""Crop, resize, pad, normalise: against the recordings, and both ways."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edge.detector.presets import KITTI_FOCAL_PX, preset
from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry, project_to_image
from runtime.contracts.manifest import Normalisation
from runtime.preprocess import network_view, normalise, prepare, to_network_image, to_planes

NORMALISED_TOLERANCE = 1e-6  # the recording's own float32 arithmetic
P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])


def geometry(width: int = 1242, height: int = 375) -> StereoGeometry:
    return StereoGeometry(P2, P3, (width, height))


def frame(width: int = 1242, height: int = 375, *, right: bool = True) -> StereoFrame:
    rng = np.random.default_rng(3)
    left = rng.integers(0, 256, (height, width, 3)).astype(np.uint8)
    return StereoFrame(left, left.copy() if right else None, 0.0, 0, "000000", geometry(width, height))


def test_stereo_model_refuses_one_view() -> None:
    manifest = preset("compact").manifest()
    single = frame(right=False)
    with pytest.raises(FrameError, match="no right image"):
        prepare(single, network_view(single.geometry, manifest), manifest)


def test_image_that_ends_above_the_crop() -> None:
    with pytest.raises(FrameError, match="taller image"):
        network_view(geometry(height=90), preset("paper").manifest())


@pytest.mark.parametrize("size_wh", [(1242, 375), (1224, 370), (640, 480), (1920, 1080), (300, 120)])
@pytest.mark.parametrize("name", ["paper", "compact"])
def test_any_camera_fills_the_input(name: str, size_wh: tuple[int, int]) -> None:
    manifest = preset(name).manifest()
    pair = frame(*size_wh)
    feeds = prepare(pair, network_view(pair.geometry, manifest), manifest)
    assert set(feeds) == {"left", "right"}
    for planes in feeds.values():
        assert planes.dtype == np.uint8 and planes.shape == (1, 3, *manifest.input_size_hw)


def test_planes_are_rgb() -> None:
    image = np.zeros((2, 3, 3), np.uint8)
    image[..., 2] = 200  # red in BGR
    planes = to_planes(image)
    assert planes.shape == (1, 3, 2, 3) and np.all(planes[0, 0] == 200) and np.all(planes[0, 1:] == 0)


@pytest.mark.parametrize("name", ["paper", "compact"])
def test_boxes_and_projection_follow_the_pixels(name: str) -> None:
    view = network_view(geometry(), preset(name).manifest())
    point = np.array([[2.0, 1.5, 18.0]])
    camera, _ = project_to_image(P2, point)
    network, _ = project_to_image(view.geometry.P2, point)
    box = np.concatenate([camera, camera], axis=1)
    np.testing.assert_allclose(view.to_network(box)[:, :2], network, atol=1e-6)


def test_compact_shows_every_camera_at_one_focal_length() -> None:
    manifest = preset("compact").manifest()
    wide = StereoGeometry(np.diag([0.6, 0.6, 1.0]) @ P2, np.diag([0.6, 0.6, 1.0]) @ P3, (745, 225))
    for camera in (geometry(), wide):
        view = network_view(camera, manifest)
        assert view.geometry.focal_px == pytest.approx(manifest.rig.focal_px)
        # the principal row lies where it did in training, to the rounding of the first row
        expected = manifest.crop.rows * manifest.rig.focal_px / KITTI_FOCAL_PX
        assert view.geometry.principal_point_px[1] == pytest.approx(expected, abs=view.scale)


def test_rows_above_the_image_are_black() -> None:
    manifest = preset("compact").manifest()
    low = StereoGeometry(P2 - np.array([[0, 0, 0, 0], [0, 0, 150.0, 0], [0, 0, 0, 0]]), P3, (1242, 225))
    view = network_view(low, manifest)
    assert view.top_row < 0
    image = to_network_image(np.full((225, 1242, 3), 255, np.uint8), view)
    padding = round(-view.top_row * view.scale)
    assert np.all(image[:padding] == 0) and np.all(image[padding : padding + 10, :800] == 255)


@pytest.mark.parametrize(("height", "width"), [(375, 1242), (370, 1224), (376, 1241)])
def test_recorded_preprocessing(golden_dir: Path, height: int, width: int) -> None:
    recorded = np.load(golden_dir / "data_pipeline.npz")
    facts = json.loads((golden_dir / "data_pipeline.json").read_text())
    key = f"pre_{height}x{width}"
    manifest = preset("paper").manifest(input_type="float32")
    view = network_view(geometry(width, height), manifest)
    np.testing.assert_allclose(view.geometry.P2, recorded[f"{key}_P2"], atol=1e-9)
    np.testing.assert_allclose(view.geometry.P3, recorded[f"{key}_P3"], atol=1e-9)
    assert facts[f"preprocess_{height}x{width}"]["left"]["shape"] == [*manifest.input_size_hw, 3]


@pytest.mark.parametrize(("height", "width"), [(80, 150), (80, 110)])
def test_recorded_pixels_cut_and_padded(golden_dir: Path, height: int, width: int) -> None:
    recorded = np.load(golden_dir / f"resized_{height}x{width}.npz")
    rgb, size_hw = recorded["rgb"], (48, 96)
    top = 80 - round(48 / _scale(recorded["P2"]))
    manifest = replace(
        preset("paper").manifest(input_type="float32"),
        input_size_hw=size_hw,
        crop=replace(preset("paper").crop, rows=top),
    )
    view = network_view(StereoGeometry(P2, P3, (width, height)), manifest)
    image = to_network_image(np.ascontiguousarray(rgb[..., ::-1]), view, as_float=True)
    ours = normalise(to_planes(image), Normalisation())[0].transpose(1, 2, 0)
    np.testing.assert_allclose(ours[::4], recorded["every_4th_row"], atol=NORMALISED_TOLERANCE)


def _scale(network_P2: np.ndarray) -> float:
    return float(network_P2[1, 1] / P2[1, 1])
