"""The frames of a choice: spread, whole pairs, written down."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.choice import METHODS, choose
from calib.frames import pixel_hash, spread_frames, spread_indices
from calib.overlap import neighbours, overlap
from runtime.contracts.errors import FormatError, SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry

GEOMETRY = StereoGeometry(np.eye(3, 4), np.eye(3, 4), (4, 2))


def frame(number: int, *, right: bool = True) -> StereoFrame:
    image = np.full((2, 4, 3), number, np.uint8)
    return StereoFrame(image, 255 - image if right else None, 0.1 * number, number, f"{number:06d}", GEOMETRY)


def choice(source, wanted, **options):
    return choose(source, wanted, name="drive", use_cache=False, **options)


@given(available=st.integers(1, 5000), wanted=st.integers(1, 600))
def test_indices_are_distinct_sorted_and_spread(available, wanted) -> None:
    indices = spread_indices(available, wanted)
    assert len(indices) == min(wanted, available)
    assert list(indices) == sorted(set(indices))
    assert indices[0] >= 0
    assert indices[-1] < available
    if wanted < available:
        gaps = np.diff([-indices[0] - 1, *indices, 2 * available - indices[-1] - 1])
        assert gaps.max() - gaps.min() <= 2 + available // wanted  # no hole, no crowd


@pytest.mark.parametrize(("available", "wanted", "said"), [(0, 5, "no frames"), (5, 0, "--frames")])
def test_none_is_refused(available, wanted, said) -> None:
    with pytest.raises(SourceError, match=said):
        spread_indices(available, wanted)


def test_an_empty_source_is_refused() -> None:
    with pytest.raises(SourceError, match="no frames"):
        list(spread_frames([], 3))


@pytest.mark.parametrize("method", METHODS)
def test_nothing_is_chosen_from_an_empty_source(method) -> None:
    with pytest.raises(SourceError, match="no frames"):
        choice([], 3, method=method)


def test_an_unknown_method_is_refused() -> None:
    with pytest.raises(FormatError, match="--choice: found 'best'"):
        choice([frame(1)], 1, method="best")


def test_a_source_is_sampled_over_its_length() -> None:
    recorded = [frame(number) for number in range(10)]
    assert [item.frame_id for item in spread_frames(recorded, 2)] == ["000002", "000007"]


@pytest.mark.parametrize("method", METHODS)
def test_a_few_are_the_first_of_those_that_calibrate(method) -> None:
    chosen = choice([frame(number) for number in range(20)], 6, method=method)
    names = [item.frame_id for item in chosen.frames()]
    assert len(set(names)) == 6
    assert [item.frame_id for item in chosen.frames(4)] == names[:4]
    assert [item.frame_id for item in chosen.chosen.first(4).frames] == names[:4]
    assert chosen.chosen.first(4).digest != chosen.chosen.digest


def test_frames_spread_in_time_stay_spread_in_each_first_part() -> None:
    indices = [
        item.index for item in choice([frame(number) for number in range(100)], 20, method="spread").chosen.frames
    ]
    assert sorted(indices) == list(spread_indices(100, 20))
    for few in (3, 5, 9):
        gaps = np.diff(sorted(indices[:few]))
        assert gaps.max() <= 2 * gaps.min() + 10  # bisection: a gap is whole or halved, to one place


def test_the_choice_is_written_down() -> None:
    chosen = choice([frame(number) for number in range(10)], 2, method="spread").chosen
    assert (chosen.source, chosen.available, chosen.method) == ("drive", 10, "spread")
    assert {item.frame_id for item in chosen.frames} == {"000002", "000007"}
    for item in chosen.frames:
        assert item.pixels == pixel_hash(frame(item.index))
    other = choice([frame(number) for number in range(9)], 2, method="spread").chosen
    assert chosen.digest != other.digest


def test_the_hash_covers_both_views() -> None:
    both, left = frame(3), frame(3, right=False)
    swapped = StereoFrame(both.right, both.left, 0.0, 0, "x", GEOMETRY)
    assert len({pixel_hash(item) for item in (both, left, swapped)}) == 3


def test_the_cameras_are_hashed_apart_from_the_pixels() -> None:
    seen = frame(3)
    moved = np.eye(3, 4)
    moved[0, 3] = -0.5
    cameras = [GEOMETRY, StereoGeometry(moved, GEOMETRY.P3, (4, 2)), StereoGeometry(GEOMETRY.P2, moved, (4, 2))]
    records = [choice([StereoFrame(seen.left, seen.right, 0.0, 0, "x", camera)], 1).chosen for camera in cameras]
    assert len({chosen.digest for chosen in records}) == 1
    assert len({chosen.geometry_digest for chosen in records}) == 3


@pytest.mark.parametrize("method", METHODS)
def test_a_check_sees_the_cameras_of_chosen_frames_and_can_end_the_reading(method) -> None:
    seen: list[StereoGeometry] = []
    choice([frame(number) for number in range(10)], 2, method=method, check=seen.append)
    assert len(seen) >= 2
    assert all(camera is GEOMETRY for camera in seen)

    def refuse(camera: StereoGeometry) -> None:
        raise SourceError("refused")

    with pytest.raises(SourceError, match="refused"):
        choice([frame(1)], 1, method=method, check=refuse)


def test_overlap_is_found_by_pixels_not_by_name() -> None:
    chosen = choice([frame(1), frame(2)], 2).chosen
    renamed = StereoFrame(frame(2).left, frame(2).right, 0.0, 0, "elsewhere/000077", GEOMETRY)
    assert overlap(chosen, [frame(5), renamed]) == ("elsewhere/000077",)
    assert overlap(chosen, [frame(5)]) == ()


@pytest.mark.parametrize(
    ("frame_id", "near"),
    [
        ("0003/000050", True),
        ("0003/000060", True),
        ("0003/000040", True),
        ("0003/000061", False),  # eleven frames on
        ("0004/000050", False),  # another drive
        ("000050", False),  # a number alone: shuffled frames
    ],
)
def test_frames_next_to_calibrating_ones_are_found_by_name(frame_id, near) -> None:
    image = frame(1).left
    chosen = choice([StereoFrame(image, image, 0.0, 0, "0003/000050", GEOMETRY)], 1).chosen
    assert neighbours(chosen, ["0003/000000", frame_id]) == ((frame_id,) if near else ())


def test_bare_numbers_of_one_drive_are_neighbours() -> None:
    image = frame(1).left
    chosen = choice([StereoFrame(image, image, 0.0, 0, "000050", GEOMETRY)], 1).chosen
    assert neighbours(chosen, ["000041", "000061"], one_drive=True) == ("000041",)
    assert neighbours(chosen, ["000041"]) == ()
