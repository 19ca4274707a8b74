"""Votes of boxes that agree with a kept one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from edge.detector.presets import preset
from runtime.boxcode import ALPHA, CX, X1, Y2, Z
from runtime.candidates import Thinning
from runtime.contracts.manifest import AnchorPriors, Manifest
from runtime.decode import Decoder
from runtime.nms import iou_one_to_many

IOU = 0.7
FLOAT32_SHARE = 1e-6
P2 = np.array([[520.0, 0, 448.0, 0], [0, 520.0, 60.0, 0], [0, 0, 1, 0]])


def box(*, shift: float = 0.0, z: float = 20.0, alpha: float = 0.1) -> np.ndarray:
    return np.array([100 + shift, 50, 160 + shift, 90, 130 + shift, 70, z, 1.6, 1.5, 4.0, alpha], np.float32)


Vote = Callable[..., np.ndarray]


@pytest.fixture(params=["numpy", "native"])
def vote(request: pytest.FixtureRequest) -> Vote:
    """Both ways to average boxes."""
    found: Thinning = Thinning() if request.param == "numpy" else request.getfixturevalue("native_thinning")
    return found.vote


@pytest.fixture
def voted(vote: Vote) -> Vote:
    """The mean that the first of a few boxes becomes."""

    def first(boxes: list[np.ndarray], score: list[float], class_id: list[int] | None = None) -> np.ndarray:
        ids = np.array([0] * len(boxes) if class_id is None else class_id)
        return vote(np.stack(boxes), np.array(score, np.float32), ids, np.array([0]), iou=IOU)[0]

    return first


def test_no_box_gives_no_box(vote: Vote) -> None:
    none = np.zeros((0, 11), np.float32)
    ids = np.zeros(0, np.int64)
    assert vote(none, np.zeros(0, np.float32), ids, ids, iou=IOU).shape == (0, 11)


def test_a_box_alone_stays_to_the_bit(voted: Vote) -> None:
    np.testing.assert_array_equal(voted([box(alpha=3.1)], [0.7]), box(alpha=3.1))


def test_boxes_that_agree_are_averaged_by_the_square_of_their_scores(voted: Vote) -> None:
    found = voted([box(), box(shift=4.0, z=21.0)], [0.8, 0.4])
    share = 0.16 / 0.80
    assert found[CX] == pytest.approx(130 + 4 * share, rel=FLOAT32_SHARE)
    assert found[Z] == pytest.approx(20 + share, rel=FLOAT32_SHARE)


@pytest.mark.parametrize(
    ("other", "score", "class_id"),
    [
        (box(shift=40.0), 0.7, 0),  # elsewhere in the image
        (box(z=30.0), 0.7, 0),  # behind it
        (box(z=21.0), 0.7, 1),  # of another class
        (box(z=21.0), 0.35, 0),  # hardly a box
    ],
)
def test_boxes_that_do_not_agree_have_no_vote(voted: Vote, other: np.ndarray, score: float, class_id: int) -> None:
    np.testing.assert_array_equal(voted([box(), other], [0.8, score], [0, class_id]), box())


def test_angles_are_averaged_across_the_turn_and_only_with_their_like(voted: Vote) -> None:
    around = voted([box(alpha=3.1), box(alpha=-3.1)], [0.8, 0.8])
    assert np.cos(around[ALPHA]) == pytest.approx(-1.0, abs=FLOAT32_SHARE)
    opposite = voted([box(alpha=0.1), box(alpha=0.1 - np.pi, z=21.0)], [0.8, 0.8])
    assert opposite[ALPHA] == pytest.approx(0.1, rel=FLOAT32_SHARE)
    assert opposite[Z] == pytest.approx(20.5, rel=FLOAT32_SHARE)


def random_outputs(manifest: Manifest) -> tuple[AnchorPriors, np.ndarray, np.ndarray]:
    """Priors of one mean, depths spread over 5 m, with logits and deltas of every anchor."""
    layout = manifest.anchors
    shape = (3, layout.scale_count, len(layout.ratios), 6)
    mean = np.broadcast_to(np.array([20, 0.1, 0.9, 1.6, 1.5, 3.9], np.float32), shape).copy()
    deviation = np.broadcast_to(np.array([5, 0.5, 0.5, 0.5, 0.5, 0.5], np.float32), shape).copy()
    rng = np.random.default_rng(3)
    count = 6 * 12 * layout.per_cell
    logits = rng.normal(-3, 2, (1, count, 4)).astype(np.float32)
    return AnchorPriors(mean, deviation), logits, rng.normal(0, 0.2, (1, count, 12)).astype(np.float32)


@pytest.fixture
def manifest() -> Manifest:
    return replace(preset("compact").manifest(), input_size_hw=(96, 192))


def test_boxes_do_not_depend_on_the_threshold_of_the_call(manifest: Manifest) -> None:
    priors, logits, deltas = random_outputs(manifest)
    decoder = Decoder(manifest, priors)
    low, high = (decoder.decode_in_network(logits, deltas, P2=P2, score=score) for score in (0.1, 0.6))
    assert 0 < len(high.score) < len(low.score)
    chosen = low.score > 0.6
    np.testing.assert_array_equal(low.anchor_index[chosen], high.anchor_index)
    np.testing.assert_array_equal(low.boxes[chosen], high.boxes)
    plain = Decoder(replace(manifest, nms=replace(manifest.nms, voting_iou=None)), priors)
    unvoted = plain.decode_in_network(logits, deltas, P2=P2, score=0.6)
    assert not np.array_equal(unvoted.boxes[:, X1 : Y2 + 1], high.boxes[:, X1 : Y2 + 1])


def test_cars_and_people_drop_each_other_only_where_depths_agree(manifest: Manifest) -> None:
    priors, logits, deltas = random_outputs(manifest)
    policy = replace(manifest.nms, voting_iou=None)
    found = {}
    for name, nms in {
        "over all": replace(policy, depth_share=None),
        "by depth": policy,
        "within classes": replace(policy, per_class=True),
    }.items():
        found[name] = Decoder(replace(manifest, nms=nms), priors).decode_in_network(logits, deltas, P2=P2, score=0.1)
    counts = [len(item.score) for item in found.values()]
    assert counts == sorted(set(counts))
    kept = found["by depth"]
    pairs = 0
    for row, box_row in enumerate(kept.boxes[:-1]):
        later = kept.boxes[row + 1 :].astype(np.float64)
        other = (kept.class_id[row + 1 :] == 0) != (kept.class_id[row] == 0)
        overlap = iou_one_to_many(box_row[X1 : Y2 + 1].astype(np.float64), later[:, X1 : Y2 + 1]) > policy.iou
        apart = np.abs(later[:, Z] - box_row[Z]) >= policy.depth_share * box_row[Z]
        assert np.all(apart[overlap])
        assert np.all(other[overlap])
        pairs += int(overlap.sum())
    assert pairs > 0


def plain_votes(boxes: np.ndarray, score: np.ndarray, class_id: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """`runtime.voting.voted_boxes` box by box, as its text says it."""
    result = boxes[keep].astype(np.float64)
    for row, index in enumerate(keep):
        kept = boxes[index].astype(np.float64)
        agree = (class_id == class_id[index]) & (score >= np.float32(0.5) * score[index])
        agree &= iou_one_to_many(kept[X1 : Y2 + 1], boxes[:, X1 : Y2 + 1].astype(np.float64)) > IOU
        agree &= np.abs(boxes[:, Z] / kept[Z] - 1.0) < 0.15
        voters, weight = boxes[agree].astype(np.float64), score[agree].astype(np.float64) ** 2
        turn_rad = np.angle(np.exp(1j * (voters[:, ALPHA] - kept[ALPHA])))
        facing = np.abs(turn_rad) < 0.8
        if len(voters) > 1:
            result[row] = weight @ voters / weight.sum()
            result[row, ALPHA] = kept[ALPHA] + weight[facing] @ turn_rad[facing] / weight[facing].sum()
    return result


@pytest.mark.parametrize("seed", range(8))
def test_many_boxes_of_mixed_classes_kept_in_any_order(vote: Vote, seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = np.stack(
        [
            box(shift=shift, z=z, alpha=alpha)
            for shift, z, alpha in zip(
                rng.uniform(0, 60, 80), rng.uniform(15, 25, 80), rng.uniform(-3.1, 3.1, 80), strict=True
            )
        ]
    )
    score = rng.choice(np.array([0.1, 0.2, 0.25, 0.4, 0.5, 0.9], np.float32), 80)  # ties, and halves of one another
    class_id = rng.integers(0, 3, 80)
    keep = rng.permutation(80)[:20]
    found = vote(boxes, score, class_id, keep, iou=IOU)
    assert (found != boxes[keep]).any(axis=1).sum() > 5
    np.testing.assert_allclose(found, plain_votes(boxes, score, class_id, keep), rtol=1e-5, atol=1e-5)
