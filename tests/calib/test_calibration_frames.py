"""The choice of frames: spread, whole pairs, written down."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from calib.frames import chosen_frames, overlap, pixel_hash, record, spread_indices
from runtime.contracts.errors import SourceError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry

GEOMETRY = StereoGeometry(np.eye(3, 4), np.eye(3, 4), (4, 2))


def frame(number: int, *, right: bool = True) -> StereoFrame:
    image = np.full((2, 4, 3), number, np.uint8)
    return StereoFrame(image, 255 - image if right else None, 0.1 * number, number, f"{number:06d}", GEOMETRY)


class Live:
    """Only iterates."""

    def __iter__(self):
        return iter([frame(number) for number in range(5)])


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


@pytest.mark.parametrize("source", [[], iter([])])
def test_an_empty_source_is_refused(source) -> None:
    with pytest.raises(SourceError, match="no frames"):
        list(chosen_frames(source, 3))


def test_recorded_sources_are_sampled_live_ones_begin_at_the_start() -> None:
    recorded = [frame(number) for number in range(10)]
    assert [item.frame_id for item in chosen_frames(recorded, 2)] == ["000002", "000007"]
    assert [item.frame_id for item in chosen_frames(Live(), 2)] == ["000000", "000001"]


@given(available=st.integers(1, 300), wanted=st.integers(1, 60), few=st.integers(1, 12))
def test_a_few_are_among_those_that_calibrate(available, wanted, few) -> None:
    recorded = list(range(available))
    all_of_them = list(chosen_frames(recorded, wanted))
    some = list(chosen_frames(recorded, wanted, few))
    assert set(some) <= set(all_of_them)
    assert len(some) == min(few, wanted, available)


def test_a_few_of_a_live_source_are_its_first() -> None:
    assert [item.frame_id for item in chosen_frames(Live(), 4, 2)] == ["000000", "000001"]


def test_the_choice_is_written_down() -> None:
    chosen = record([frame(number) for number in range(10)], 2, name="drive")
    assert (chosen.source, chosen.available) == ("drive", 10)
    assert [item.frame_id for item in chosen.frames] == ["000002", "000007"]
    assert chosen.frames[0].pixels == pixel_hash(frame(2))
    assert chosen.digest != record([frame(number) for number in range(9)], 2, name="drive").digest
    assert record(Live(), 2, name="camera").available is None


def test_the_hash_covers_both_views() -> None:
    both, left = frame(3), frame(3, right=False)
    swapped = StereoFrame(both.right, both.left, 0.0, 0, "x", GEOMETRY)
    assert len({pixel_hash(item) for item in (both, left, swapped)}) == 3


def test_the_cameras_are_hashed_apart_from_the_pixels() -> None:
    seen = frame(3)
    moved = np.eye(3, 4)
    moved[0, 3] = -0.5
    cameras = [GEOMETRY, StereoGeometry(moved, GEOMETRY.P3, (4, 2)), StereoGeometry(GEOMETRY.P2, moved, (4, 2))]
    records = [record([StereoFrame(seen.left, seen.right, 0.0, 0, "x", camera)], 1, name="drive") for camera in cameras]
    assert len({chosen.digest for chosen in records}) == 1
    assert len({chosen.geometry_digest for chosen in records}) == 3


def test_a_check_sees_the_chosen_frames_and_can_end_the_reading() -> None:
    seen: list[str] = []
    record([frame(number) for number in range(10)], 2, name="drive", check=lambda item: seen.append(item.frame_id))
    assert seen == ["000002", "000007"]

    def refuse(item: StereoFrame) -> None:
        raise SourceError("refused")

    with pytest.raises(SourceError, match="refused"):
        record([frame(1)], 1, name="drive", check=refuse)


def test_overlap_is_found_by_pixels_not_by_name() -> None:
    chosen = record([frame(1), frame(2)], 2, name="drive")
    renamed = StereoFrame(frame(2).left, frame(2).right, 0.0, 0, "elsewhere/000077", GEOMETRY)
    assert overlap(chosen, [frame(5), renamed]) == ("elsewhere/000077",)
    assert overlap(chosen, [frame(5)]) == ()
