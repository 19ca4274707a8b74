"""Runs without objects, with an average of their own, validated, resumed from older checkpoints, logged as events."""

from __future__ import annotations

import copy
import csv
import json
import struct
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the torch workbench is not installed")

from edge.detector.network import StereoDetector  # noqa: E402
from edge.detector.presets import with_frozen_backbone  # noqa: E402
from edge.detector.weights import load_weights  # noqa: E402
from edge.evaluation.kitti_ap import evaluate  # noqa: E402
from edge.training.checkpoint import BEST_FILE, CHECKPOINT_FILE, AveragedModel, load_checkpoint  # noqa: E402
from edge.training.event_log import EVENTS_FOLDER, EventLog  # noqa: E402
from edge.training.loop import train  # noqa: E402
from edge.training.precision import wants_mixed_precision  # noqa: E402
from edge.training.run_record import RunSettings, check_same_run, write_settings  # noqa: E402
from edge.training.samples import SampleMaker  # noqa: E402
from edge.training.schedule import Schedule, cosine_rate, schedule_kind, steps_of  # noqa: E402
from edge.training.start import run_steps  # noqa: E402
from edge.training.stream import MixedFrames  # noqa: E402
from edge.training.validation import VALIDATION_FILE, Validation, mean_moderate_ap  # noqa: E402
from runtime.contracts.errors import EdgeError, FrameError, SourceError  # noqa: E402
from runtime.contracts.objects import Detections3D  # noqa: E402
from runtime.refinement import refiner  # noqa: E402

pytestmark = [pytest.mark.torch, pytest.mark.usefixtures("one_thread")]

HALF_PRECISION = 1e-3  # of weights files
SETTINGS = RunSettings(
    4, 2, 2e-3, 1e-4, warmup_steps=2, workers=0, mixed_precision=False, checkpoint_every=2, log_every=1
)


def run(toy: ModuleType, folder: Path, *, frames: Any = None, resume: bool = False, **changes: Any) -> Any:
    """A run with dropout, so that the generator's state matters."""
    folder.mkdir(exist_ok=True)
    chosen = toy.tiny_preset()
    chosen = replace(chosen, network=replace(chosen.network, head=replace(chosen.network.head, dropout=0.5)))
    torch.manual_seed(5)
    detector = StereoDetector(chosen)
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    mixed = MixedFrames([frames or toy.DrawnFrames()], [1], maker=maker, seed=2)
    validate = changes.pop("validate", None)
    if validate is not None:
        validate = validate(detector)
    average = train(
        detector,
        chosen,
        mixed,
        settings=replace(SETTINGS, **changes),
        run_dir=folder,
        resume=resume,
        validate=validate,
    )
    return detector, average


def same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> bool:
    return set(one) == set(other) and all(torch.equal(one[name], other[name]) for name in one)


def test_batches_without_objects_change_no_weight_and_do_not_fail(toy: ModuleType, tmp_path: Path) -> None:
    class Empty(toy.DrawnFrames):  # type: ignore[name-defined, misc]
        def labels(self, index: int) -> Any:
            return super().labels(1)  # a frame without cars

    detector, _ = run(toy, tmp_path / "empty", frames=Empty())
    torch.manual_seed(5)
    fresh = StereoDetector(toy.tiny_preset())
    parameters = dict(detector.named_parameters())
    with (tmp_path / "empty/log.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    taught = any(float(row["class_loss"]) for row in rows)  # by option, empty images teach background
    for name, parameter in fresh.named_parameters():
        assert torch.isfinite(parameters[name]).all()
        assert taught or torch.equal(parameters[name], parameter), name
    assert len(rows) == 4
    assert all(float(row["box_loss"]) == 0 for row in rows)


def test_resumed_run_equals_the_uninterrupted_one_to_the_bit(toy: ModuleType, tmp_path: Path) -> None:
    whole, whole_average = run(toy, tmp_path / "whole")
    run(toy, tmp_path / "parts", steps=2)
    parts, parts_average = run(toy, tmp_path / "parts", resume=True)
    assert same(whole.state_dict(), parts.state_dict())
    assert same(whole_average.state, parts_average.state)


def test_checkpoint_without_the_generators_of_each_process_resumes(toy: ModuleType, tmp_path: Path) -> None:
    whole, _ = run(toy, tmp_path / "whole")
    run(toy, tmp_path / "parts", steps=2)
    file = tmp_path / "parts" / CHECKPOINT_FILE
    state = load_checkpoint(file)
    del state["rank_rng"]  # version 0.1.0 wrote "rng" and "cuda_rng" alone
    torch.save(state, file)
    parts, _ = run(toy, tmp_path / "parts", resume=True)
    assert same(whole.state_dict(), parts.state_dict())


def test_lines_after_the_checkpoint_are_not_logged_twice(toy: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run(toy, folder, steps=2)
    early = (folder / CHECKPOINT_FILE).read_bytes()
    run(toy, folder, resume=True)
    (folder / CHECKPOINT_FILE).write_bytes(early)  # as if stopped between step 2 and the next checkpoint
    run(toy, folder, resume=True)
    with (folder / "log.csv").open(newline="") as stream:
        assert [row["step"] for row in csv.DictReader(stream)] == ["1", "2", "3", "4"]


@pytest.mark.parametrize("parts", [0, 3])
def test_frozen_parts_of_the_backbone_keep_their_weights_and_the_others_learn(
    toy: ModuleType, tmp_path: Path, parts: int
) -> None:
    chosen = with_frozen_backbone(toy.tiny_preset(), parts)
    torch.manual_seed(5)
    detector = StereoDetector(chosen)
    before = copy.deepcopy(detector.backbone)
    maker = SampleMaker(chosen, toy.plain_priors(chosen))
    frames = MixedFrames([toy.DrawnFrames()], [1], maker=maker, seed=2)
    train(detector, chosen, frames, settings=SETTINGS, run_dir=tmp_path, resume=False)
    for index, (old, new) in enumerate(zip(before.parts(), detector.backbone.parts(), strict=True)):
        kept = all(torch.equal(a, b) for a, b in zip(old.parameters(), new.parameters(), strict=True))
        assert kept == (index < parts), index


def test_average_of_decay_zero_is_the_last_state_and_a_shorter_memory_is_nearer_to_it() -> None:
    module = torch.nn.Linear(2, 2)
    averages = {decay: AveragedModel(module, decay) for decay in (0.0, 0.9, 0.999)}
    for step in range(1, 400):
        with torch.no_grad():
            module.weight += 0.01
        for average in averages.values():
            average.update(module, step)
    last = module.weight.detach()
    distance = {decay: float((average.state["weight"] - last).abs().max()) for decay, average in averages.items()}
    assert distance[0.0] == 0
    assert 0 < distance[0.9] < distance[0.999]


def test_cosine_moves_once_an_epoch() -> None:
    plan = Schedule("cosine", 1e-4, 5e-6, total_steps=steps_of(3, epoch_samples=10, batch_size=4), batch_size=4,
                    epoch_samples=10)  # fmt: skip
    rates = [plan.rate(step) for step in range(plan.total_steps)]
    assert plan.total_steps == 8 and plan.epochs == 3
    expected = [cosine_rate(epoch, 3, peak=1e-4, final=5e-6) for epoch in (0, 0, 0, 1, 1, 2, 2, 2)]
    assert rates == expected
    with pytest.raises(EdgeError, match="expected hold, cosine"):
        schedule_kind("linear")


def test_length_of_a_run(toy: ModuleType) -> None:
    chosen = toy.tiny_preset()
    given = {"epoch_samples": 10, "batch_size": 4}
    assert run_steps(chosen, steps=7, epochs=None, **given) == 7
    assert run_steps(chosen, steps=None, epochs=2, **given) == 5
    assert run_steps(chosen, steps=None, epochs=None, **given) == 10000
    paper = replace(chosen, training=replace(chosen.training, epochs=50))
    assert run_steps(paper, steps=None, epochs=None, **given) == 125
    with pytest.raises(EdgeError, match="leave one out"):
        run_steps(chosen, steps=7, epochs=2, **given)
    assert run_steps(paper, steps=None, epochs=None, before=30, done=30, **given) == 30  # a resumed run keeps its own
    assert run_steps(chosen, steps=40, epochs=None, before=30, done=30, **given) == 40
    with pytest.raises(EdgeError, match="has done 30"):
        run_steps(chosen, steps=29, epochs=None, before=30, done=30, **given)


def test_precision_words() -> None:
    assert wants_mixed_precision("bf16", "cpu") and not wants_mixed_precision("float32", "cuda")
    with pytest.raises(EdgeError, match="expected auto, bf16 or float32"):
        wants_mixed_precision("half", "cpu")


def test_preset_with_fields_added_since_is_the_same_run(toy: ModuleType, tmp_path: Path) -> None:
    chosen = toy.tiny_preset()
    write_settings(tmp_path, chosen, SETTINGS, {"a": 1}, origin={"method": "preset"})
    file = tmp_path / "run.json"
    record = json.loads(file.read_text())
    del record["preset"]["training"]["epochs"], record["stages"][0]["settings"]["average_decay"]
    file.write_text(json.dumps(record))
    known = {"seed": SETTINGS.seed, "batch_size": SETTINGS.batch_size}
    check_same_run(tmp_path, chosen, **known)
    write_settings(tmp_path, chosen, SETTINGS, {"a": 1}, origin={"method": "preset"})
    assert json.loads(file.read_text())["stages"][1]["preset"] == json.loads(json.dumps(asdict(chosen)))
    head = record["preset"]["network"]["head"]
    head["final_kernel"] = head.pop("class_final_kernel")
    del head["box_final_kernel"]
    file.write_text(json.dumps(record))
    check_same_run(tmp_path, chosen, **known)
    other = replace(chosen, training=replace(chosen.training, z_weight=1.0))
    with pytest.raises(EdgeError, match=r"with preset\.training\.z_weight 12\.0, found 1\.0"):
        check_same_run(tmp_path, other, **known)


def events_of(folder: Path) -> list[Any]:
    """Events of all files, read by the format's definition: length, its checksum, record, its checksum."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2", reason="tensorboardX is not installed")
    events = []
    for file in sorted(folder.iterdir()):
        data, at = file.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            events.append(event_pb2.Event.FromString(data[at + 12 : at + 12 + length]))
            at += 16 + length
    return events


def test_event_log_of_nothing_and_of_a_process_that_does_not_write(tmp_path: Path) -> None:
    with EventLog(tmp_path / "silent", enabled=False) as log:
        log.add(1, {"a": 1.0})
    assert not (tmp_path / "silent").exists()


def test_event_files_hold_what_the_log_holds(toy: ModuleType, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    run(toy, folder, steps=2)
    run(toy, folder, resume=True)
    found = {(e.step, v.tag): v.simple_value for e in events_of(folder / EVENTS_FOLDER) for v in e.summary.value}
    with (folder / "log.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 4
    for row in rows:
        for name in ("learning_rate", "class_loss", "box_loss", "disparity_loss", "gradient_norm"):
            assert found[int(row["step"]), f"train/{name}"] == pytest.approx(float(row[name]), rel=1e-5), name
    assert [found[step, "train/epoch"] for step in range(1, 5)] == [0, 0, 0, 1]  # six frames, two a step


def test_validation_measures_the_average_and_keeps_the_best(
    toy: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen, folder = toy.tiny_preset(), tmp_path / "run"
    chosen = replace(chosen, network=replace(chosen.network, head=replace(chosen.network.head, dropout=0.5)))
    states: dict[int, dict[str, torch.Tensor]] = {}

    def measured(detector: torch.nn.Module, first_step: int = 0) -> Any:
        inner = Validation(
            detector,
            chosen,
            toy.plain_priors(chosen),
            frames=toy.DrawnFrames(),
            run_dir=folder,
            metadata={"preset": "tiny"},
            first_step=first_step,
        )

        def call(state: dict[str, torch.Tensor], step: int) -> dict[str, float]:
            states[step] = {name: value.clone() for name, value in state.items()}
            return inner(state, step)

        return call

    scores = iter([5.0, 9.0, 7.0, 8.0])
    monkeypatch.setattr("edge.training.validation.mean_moderate_ap", lambda evaluation: next(scores, 1.0))
    monkeypatch.setattr("edge.training.validation.scalars", lambda evaluation: {"validation/frames": evaluation.frames})
    plain, _ = run(toy, tmp_path / "plain")
    detector, average = run(toy, folder, validate=measured, validate_every=1)
    assert same(plain.state_dict(), detector.state_dict())  # looking changes nothing, dropout's draws included
    lines = [json.loads(line) for line in (folder / VALIDATION_FILE).read_text().splitlines()]
    assert [(line["step"], line["score"]) for line in lines] == [(1, 5.0), (2, 9.0), (3, 7.0), (4, 8.0)]
    assert lines[0]["frames"] == len(toy.CARS_A_FRAME)
    assert lines[0]["objects"]["Car"][1] > 0 and set(lines[0]["ap"]["Car"]) >= {"2d", "bev", "3d"}
    assert same(states[4], average.state)
    best = StereoDetector(chosen)
    load_weights(best, folder / BEST_FILE)
    for name, value in best.state_dict().items():
        if value.dtype.is_floating_point:
            torch.testing.assert_close(value, states[2][name], rtol=HALF_PRECISION, atol=HALF_PRECISION)
    tags = {v.tag: v.simple_value for e in events_of(folder / EVENTS_FOLDER) for v in e.summary.value}
    assert tags["validation/frames"] == len(toy.CARS_A_FRAME)
    measured(detector, first_step=3)  # as a resumed run does
    assert [json.loads(line)["step"] for line in (folder / VALIDATION_FILE).read_text().splitlines()] == [1, 2, 3]


class KnowsTheAnswer(torch.nn.Module):
    """Says what one frame's targets are, whatever it sees; ``certainty`` is its logit."""

    def __init__(self, targets: Any, classes: int) -> None:
        super().__init__()
        logits = torch.full((1, len(targets.label), classes + 1), -9.0)
        deltas = torch.zeros(1, len(targets.label), 12)
        label = targets.label[targets.positive].astype(np.int64)
        logits[0, targets.positive, label - 1] = 9.0
        logits[0, targets.positive, -1] = torch.from_numpy(18 * targets.facing - 9)
        deltas[0, targets.positive] = torch.from_numpy(targets.deltas)
        self.certainty = torch.nn.Parameter(torch.zeros(()))
        self.register_buffer("logits", logits)
        self.register_buffer("deltas", deltas)

    def forward(self, left: torch.Tensor, right: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.logits * self.certainty, self.deltas


def test_validation_finds_what_the_labels_say(toy: ModuleType, tmp_path: Path) -> None:
    chosen, priors = replace(toy.tiny_preset(), depth_refinement=False), toy.plain_priors(toy.tiny_preset())

    class OneCar(toy.DrawnFrames):  # type: ignore[name-defined, misc]
        def labels(self, index: int) -> Any:
            return super().labels(2)  # the frame with one car

    class Unlabelled(toy.DrawnFrames):  # type: ignore[name-defined, misc]
        uri = "drawn:"

        def labels(self, index: int) -> None:
            return None

    frames = OneCar()
    sample = SampleMaker(chosen, priors, augment=False).make(frames[0], frames.labels(0), np.random.RandomState(0))
    detector = KnowsTheAnswer(sample.targets, len(chosen.classes))
    given = {"run_dir": tmp_path, "metadata": {}}

    class OneView(OneCar):
        def __getitem__(self, index: int) -> Any:
            return replace(super().__getitem__(index), right=None)

    with pytest.raises(FrameError, match="has no right image"):
        Validation(detector, chosen, priors, frames=OneView(), **given)
    with pytest.raises(SourceError, match="no labelled frame"):
        Validation(detector, chosen, priors, frames=Unlabelled(), **given)
    validate = Validation(detector, chosen, priors, frames=frames, **given)
    state = detector.state_dict()
    certain = validate(state | {"certainty": torch.ones(())}, 1)
    blind = validate(state | {"certainty": -torch.ones(())}, 2)  # sure of all that is not there, and not of the car

    truth = frames.labels(0)
    perfect = Detections3D(
        class_id=truth.class_id,
        score=np.full(len(truth), 0.99),
        box_in_left_image=truth.box_in_left_image,
        center_in_camera=truth.center_in_camera,
        size_hwl=truth.size_hwl,
        alpha_rad=truth.alpha_rad,
        yaw_rad=truth.yaw_rad,
        class_names=truth.class_names,
    )
    best = evaluate([truth] * len(frames), [perfect] * len(frames), chosen.classes)
    assert certain["validation/score"] == mean_moderate_ap(best) > 0
    assert certain["validation/Car_3d_0.7_moderate"] == mean_moderate_ap(best)  # the one class that occurs
    assert blind["validation/score"] == 0


def test_validation_refines_depths_as_the_exported_model_does(
    toy: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen, priors = toy.tiny_preset(), toy.plain_priors(toy.tiny_preset())
    frames = toy.DrawnFrames()
    sample = SampleMaker(chosen, priors, augment=False).make(frames[2], frames.labels(2), np.random.RandomState(0))
    detector = KnowsTheAnswer(sample.targets, len(chosen.classes))
    measured: list[Detections3D] = []

    def listening(labels: Any, detections: list[Detections3D], classes: tuple[str, ...]) -> Any:
        measured[:] = detections
        return evaluate(labels, detections, classes)

    monkeypatch.setattr("edge.training.validation.evaluate", listening)
    assert chosen.depth_refinement
    centers = {}
    for refines in (True, False):
        validate = Validation(
            detector,
            replace(chosen, depth_refinement=refines),
            priors,
            frames=frames,
            run_dir=tmp_path,
            metadata={},
        )
        validate(detector.state_dict() | {"certainty": torch.ones(())}, 1)
        centers[refines] = [found.center_in_camera for found in measured]
    found = replace(measured[2], center_in_camera=centers[False][2])
    assert len(found) > 0
    expected = refiner()(found, frames[2].left, frames[2].right, frames[2].geometry).detections.center_in_camera
    np.testing.assert_array_equal(centers[True][2], expected)
    assert not np.array_equal(centers[True][2], centers[False][2])


@pytest.mark.device
def test_a_gpu_trains_in_mixed_precision(toy: ModuleType, tmp_path: Path) -> None:
    if not torch.cuda.is_available():
        pytest.skip("no GPU")
    _, average = run(toy, tmp_path / "run", device="cuda", mixed_precision=True)
    assert all(value.isfinite().all() for value in average.state.values())
    run(toy, tmp_path / "run", device="cuda", mixed_precision=True, steps=6, resume=True)
