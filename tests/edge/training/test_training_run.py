"""The stream of samples, resuming, and a run that learns."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import HeadShape, NeckShape, NetworkShape, Preset, preset, with_frozen_backbone  # noqa: E402
from edge.detector.weights import PRIORS_KEY, check_priors, load_weights, priors_digest, save_weights  # noqa: E402
from edge.training.ground_truth import alpha_of_yaw, mirror_geometry, mirror_objects, outline_boxes  # noqa: E402
from edge.training.loop import train  # noqa: E402
from edge.training.origin import start_notes  # noqa: E402
from edge.training.run_record import RunSettings, check_same_run, length_before, write_settings  # noqa: E402
from edge.training.samples import SampleMaker  # noqa: E402
from edge.training.schedule import Schedule  # noqa: E402
from edge.training.stream import MixedFrames  # noqa: E402
from runtime.contracts.errors import CheckpointError  # noqa: E402
from runtime.contracts.geometry import StereoGeometry  # noqa: E402
from runtime.contracts.kitti import format_calib, parse_labels  # noqa: E402
from runtime.contracts.manifest import AnchorPriors  # noqa: E402
from runtime.sources.factory import open_sequence  # noqa: E402

pytestmark = pytest.mark.torch

P2 = np.array([[721.5377, 0, 609.5593, 44.85728], [0, 721.5377, 172.854, 0.2163791], [0, 0, 1, 0.002745884]])
P3 = np.array([[721.5377, 0, 609.5593, -339.5242], [0, 721.5377, 172.854, 2.199936], [0, 0, 1, 0.002729905]])
CAR = "Car 0.00 0 -1.58 {x} 173.33 {x2} 200.12 1.65 1.67 3.64 -0.65 1.71 26.70 -1.59\n"


@pytest.fixture(autouse=True)
def _one_thread():  # type: ignore[no-untyped-def]
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


def small_preset() -> Preset:
    """The compact preset's structure, a few channels wide."""
    compact = preset("compact")
    neck = NeckShape(16, 8, 8, 4, 16, 16, 16, (16, 16), 96)
    network = NetworkShape(18, (16, 16, 16), neck, HeadShape(16, 16, 1, 1, 0.0, 0.01))
    training = replace(compact.training, frozen_backbone_parts=0)
    return replace(
        compact, input_size_hw=(96, 448), rig=replace(compact.rig, focal_px=260.0), network=network, training=training
    )


def plain_priors(chosen: Preset) -> AnchorPriors:
    shape = (len(chosen.classes), chosen.anchors.scale_count, len(chosen.anchors.ratios), 6)
    mean = np.broadcast_to(np.array([25, 0, -0.5, 1.6, 1.5, 3.9], np.float32), shape).copy()
    return AnchorPriors(mean, np.broadcast_to(np.array([8, 0.7, 0.7, 0.2, 0.2, 0.5], np.float32), shape).copy())


@pytest.fixture
def dataset(tmp_path: Path) -> str:
    root = tmp_path / "drive"
    for folder in ("image_2", "image_3", "calib", "label_2"):
        (root / "training" / folder).mkdir(parents=True)
    rng = np.random.default_rng(0)
    for name, x in (("000000", 300), ("000001", 600), ("000002", 900)):
        for folder in ("image_2", "image_3"):
            image = rng.integers(60, 90, (375, 1242, 3)).astype(np.uint8)
            image[173:200, x : x + 60] = (20, 20, 230)
            cv2.imwrite(str(root / "training" / folder / f"{name}.png"), image)
        (root / "training/calib" / f"{name}.txt").write_text(format_calib(StereoGeometry(P2, P3, (1242, 375))))
        (root / "training/label_2" / f"{name}.txt").write_text(CAR.format(x=x, x2=x + 60))
    return f"kitti-object:{root}"


def settings(steps: int, **changes: object) -> RunSettings:
    base = RunSettings(
        steps,
        2,
        2e-3,
        1e-4,
        cooldown_steps=2,
        warmup_steps=2,
        workers=0,
        mixed_precision=False,
        checkpoint_every=4,
        log_every=1,
    )
    return replace(base, **changes)  # type: ignore[arg-type]


def run(dataset: str, folder: Path, steps: int, *, resume: bool = False) -> dict[str, torch.Tensor]:
    chosen = small_preset()
    folder.mkdir(exist_ok=True)
    torch.manual_seed(1)
    detector = StereoDetector(chosen)
    frames = MixedFrames([open_sequence(dataset)], [1], maker=SampleMaker(chosen, plain_priors(chosen)), seed=3)
    plan = settings(steps, cooldown_steps=0)
    return train(detector, chosen, frames, settings=plan, run_dir=folder, resume=resume).state


def test_position_fixes_the_sample(dataset: str) -> None:
    chosen = small_preset()

    def frames() -> MixedFrames:
        return MixedFrames([open_sequence(dataset)], [2], maker=SampleMaker(chosen, plain_priors(chosen)), seed=7)

    first, second = frames(), frames()
    assert first.epoch_length == 6
    late = second[8]  # another order of asking
    for position in range(8):
        first[position]
    np.testing.assert_array_equal(first[8].left, late.left)
    np.testing.assert_array_equal(first[8].targets.deltas, late.targets.deltas)


def test_resumed_run_equals_the_uninterrupted_one(dataset: str, tmp_path: Path) -> None:
    whole = run(dataset, tmp_path / "whole", 8)
    run(dataset, tmp_path / "parts", 4)
    parts = run(dataset, tmp_path / "parts", 8, resume=True)
    assert all(torch.equal(whole[name], parts[name]) for name in whole)


def test_loss_falls_and_is_logged(dataset: str, tmp_path: Path) -> None:
    run(dataset, tmp_path / "run", 40)
    with (tmp_path / "run/log.csv").open(newline="") as stream:
        rows = [float(row["box_loss"]) for row in csv.DictReader(stream)]
    assert len(rows) == 40
    assert np.mean(rows[-8:]) < 0.7 * np.mean(rows[:8])


def test_resume_without_checkpoint_is_one_line(dataset: str, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="without --resume"):
        run(dataset, tmp_path / "none", 4, resume=True)


def test_weights_round_trip_and_refusal(tmp_path: Path) -> None:
    chosen = small_preset()
    detector, other = StereoDetector(chosen), StereoDetector(chosen)
    file = tmp_path / "weights.safetensors"
    save_weights(file, detector.state_dict(), metadata={"preset": chosen.name})
    load_weights(other, file)
    branch = next(name for name in detector.state_dict() if name.startswith("disparity_branch"))
    for name in ("head.regression.0.0.weight", branch):
        torch.testing.assert_close(other.state_dict()[name], detector.state_dict()[name], atol=1e-3, rtol=1e-3)
    notes = partial(start_notes, preset=chosen, priors=plain_priors(chosen))
    assert notes(file, backbone=None, resume=False) == notes(None, backbone=None, resume=True) == []
    assert notes(None, backbone=file, resume=False) == []
    assert ["backbone is random" in note for note in notes(None, backbone=None, resume=False)] == [True]
    bare = tmp_path / "bare.safetensors"
    without = {name: value for name, value in detector.state_dict().items() if not name.startswith("disparity_branch")}
    save_weights(bare, without, metadata={"preset": chosen.name})
    load_weights(other, bare)
    assert ["starts anew" in note for note in notes(bare, backbone=None, resume=False)] == [True]
    with pytest.raises(CheckpointError, match="expected the weights of this preset"):
        load_weights(StereoDetector(replace(chosen, classes=("Car",))), file)
    file.write_bytes(b"not weights")
    with pytest.raises(CheckpointError, match="no safetensors"):
        load_weights(other, file)


def test_weights_know_their_priors(tmp_path: Path) -> None:
    chosen = small_preset()
    tables = plain_priors(chosen)
    file = tmp_path / "weights.safetensors"
    metadata = {PRIORS_KEY: priors_digest(tables, chosen.classes)}
    save_weights(file, StereoDetector(chosen).state_dict(), metadata=metadata)
    check_priors(file, tables, chosen.classes)
    with pytest.raises(CheckpointError, match="other priors"):
        check_priors(file, AnchorPriors(tables.mean + 1, tables.std), chosen.classes)


def test_only_the_same_run_is_resumed(tmp_path: Path) -> None:
    chosen = small_preset()
    with pytest.raises(CheckpointError, match="does not describe a run"):
        check_same_run(tmp_path, chosen, seed=0, batch_size=2)
    write_settings(tmp_path, chosen, settings(8), {"a": 1}, origin={"method": "preset"})
    assert length_before(tmp_path) == 8
    known = {"seed": settings(8).seed, "batch_size": settings(8).batch_size}
    check_same_run(tmp_path, chosen, **known)
    frozen = with_frozen_backbone(chosen, 4)
    for other, given, word in (
        (chosen, known | {"seed": 9}, "--seed"),
        (chosen, known | {"batch_size": 16}, "--batch"),
        (preset("compact"), known, r"preset\.input_size_hw"),
        (frozen, known, r"preset\.training\.frozen_backbone_parts"),
    ):
        with pytest.raises(CheckpointError, match=word):
            check_same_run(tmp_path, other, **given)


def test_pickles_do_not_run(tmp_path: Path) -> None:
    import pickle  # noqa: TID251 - the attack itself

    class Bomb:
        def __reduce__(self):  # type: ignore[no-untyped-def]
            return (Path.touch, (tmp_path / "ran",))

    file = tmp_path / "weights.pt"
    file.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(CheckpointError):
        load_weights(StereoDetector(small_preset()), file)
    assert not (tmp_path / "ran").exists()


def test_mirrored_object_projects_to_the_mirrored_place() -> None:
    objects = parse_labels(CAR.format(x=587, x2=614))
    geometry = StereoGeometry(P2, P3, (1242, 375))
    mirrored = mirror_geometry(geometry)
    turned = mirror_objects(objects, mirrored.P2)
    # the mirrored left view is the old right view seen in a mirror
    right = outline_boxes(alpha_of_yaw(objects, geometry.P3), geometry.P3)[0]
    left = outline_boxes(turned, mirrored.P2)[0]
    np.testing.assert_allclose(left, [1241 - right[2], right[1], 1241 - right[0], right[3]], atol=0.2)
    assert mirrored.baseline_m == pytest.approx(geometry.baseline_m)
    again = mirror_objects(turned, mirror_geometry(mirrored).P2)
    np.testing.assert_allclose(again.yaw_rad, objects.yaw_rad, atol=1e-9)
    np.testing.assert_allclose(again.center_in_camera, objects.center_in_camera)


def test_schedule_holds_then_falls() -> None:
    plan = Schedule("hold", 1.0, 0.1, total_steps=100, warmup_steps=10, cooldown_steps=20)
    assert plan.rate(0) == pytest.approx(0.1)
    assert plan.rate(10) == plan.rate(80) == 1.0
    assert plan.rate(90) == pytest.approx(0.55)
    assert plan.rate(99) == pytest.approx(0.1 + 0.9 / 20)
