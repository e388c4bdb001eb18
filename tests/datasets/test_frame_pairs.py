"""Pairing by time: one to one, the nearest first, within the stated tolerance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam.datasets import ReadReport
from slam.datasets.account import Account
from slam.datasets.frame_pairs import NO_COLOR, NO_DEPTH, nearest_partners, pair_images
from slam.datasets.stamped_files import StampedFile

STAMPS = st.lists(st.floats(0.0, 1.0), max_size=25).map(np.array)


def listed(stamps: list[float]) -> list[StampedFile]:
    return [StampedFile(stamp, Path(f"{k}.png"), k + 1) for k, stamp in enumerate(stamps)]


def paired(colors: list[float], depths: list[float]) -> tuple[list[tuple[float, float]], ReadReport]:
    report = ReadReport()
    pairs = pair_images(listed(colors), listed(depths), Account("log", report, False), "camera")
    return [(pair.stamp_s, pair.depth.stamp_s) for pair in pairs], report


def test_the_nearest_wins_and_the_rest_is_counted() -> None:
    pairs, report = paired([1.0, 1.033, 1.066, 5.0], [1.001, 1.040, 1.036, 9.0])
    assert pairs == [(1.0, 1.001), (1.033, 1.036)]
    assert {key: tally.count for key, tally in report.dropped.items()} == {NO_DEPTH: 2, NO_COLOR: 2}
    (note,) = report.notes
    assert "within 0.020 s" in note


def test_a_nearer_partner_is_not_lost_to_an_earlier_image() -> None:
    assert nearest_partners(np.array([1.0, 1.015]), np.array([1.012]), 0.02).tolist() == [-1, 0]


def test_the_order_of_the_list_is_kept_whatever_the_stamps() -> None:
    pairs, _ = paired([2.0, 1.0, 3.0], [1.0, 2.0, 3.0])
    assert pairs == [(2.0, 2.0), (1.0, 1.0), (3.0, 3.0)]


def test_slow_cameras_out_of_step_are_paired_within_half_an_interval_and_it_is_said() -> None:
    colors = [0.1 * k for k in range(10)]
    pairs, report = paired(colors, [stamp + 0.04 for stamp in colors])
    assert len(pairs) == 10
    (note,) = report.notes
    assert "within 0.050 s" in note


def test_some_lost_depth_images_widen_nothing() -> None:
    colors = [0.1 * k for k in range(10)]
    pairs, report = paired(colors, [stamp + 0.001 for stamp in colors[::2]] + [0.14])
    assert len(pairs) == 5
    assert "within 0.020 s" in next(iter(report.notes))


@settings(deadline=None, max_examples=200)
@given(first=STAMPS, second=STAMPS, tolerance=st.floats(0.0, 0.3))
def test_partners_are_one_to_one_and_near_enough(
    first: np.ndarray, second: np.ndarray, tolerance: float
) -> None:
    partner = nearest_partners(first, second, tolerance)
    taken = partner[partner >= 0]
    assert len(set(taken.tolist())) == taken.size
    assert np.all(np.abs(second[taken] - first[partner >= 0]) <= tolerance)


def test_equal_stamps_find_different_partners() -> None:
    partner = nearest_partners(np.array([1.0, 1.0]), np.array([1.0, 1.0]), 0.0)
    assert sorted(partner.tolist()) == [0, 1]


def test_nothing_pairs_with_nothing() -> None:
    assert paired([], [1.0])[0] == []
    assert paired([1.0], [])[1].dropped[NO_DEPTH].count == 1
    with pytest.raises(StopIteration):
        next(iter(paired([], [])[1].notes))
