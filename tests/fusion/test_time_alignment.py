"""Stamps that belong together, and the offset between two clocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import fusion

stamps = st.lists(st.floats(0.0, 100.0), max_size=30).map(np.array)


@given(stamps, stamps, st.floats(0.0, 5.0))
def test_pairs_are_one_to_one_near_and_each_others_nearest(a, b, tolerance):
    pairs = fusion.pair_stamps(a, b, tolerance)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
    for i, j in pairs:
        assert abs(a[i] - b[j]) <= tolerance
        assert abs(a[i] - b[j]) == np.abs(b - a[i]).min() == np.abs(a - b[j]).min()


def test_the_tolerance_is_inclusive_and_order_does_not_matter():
    pairs = fusion.pair_stamps(np.array([2.0, 1.0, 9.0]), np.array([1.5, 8.0, 2.25]), 0.5)
    assert pairs.tolist() == [[1, 0], [0, 2]]


def test_nothing_pairs_with_nothing_and_bad_stamps_are_refused():
    assert fusion.pair_stamps(np.array([]), np.array([1.0]), 1.0).shape == (0, 2)
    with pytest.raises(ValueError, match="finite"):
        fusion.pair_stamps(np.array([np.nan]), np.array([1.0]), 1.0)


def rates(stamps_s, offset_s, rng, noise=0.02):
    """A yaw rate that a clock with an offset stamps."""
    true = stamps_s - offset_s
    return 0.6 * np.sin(0.9 * true) + 0.4 * np.sin(2.3 * true + 1.0) + noise * rng.standard_normal(true.size)


@pytest.mark.parametrize("offset", [-0.31, 0.0, 0.0437, 0.62])
def test_the_offset_is_found_below_a_sample(offset):
    rng = np.random.default_rng(1)
    first, second = np.arange(0.0, 60.0, 0.1), np.arange(0.02, 60.0, 0.033)
    found = fusion.clock_offset(first, rates(first, 0.0, rng), second, rates(second, offset, rng))
    assert found is not None
    assert abs(found.offset_s - offset) < 0.006
    assert found.correlation > 0.98


def test_the_offsets_sigma_is_the_scatter_of_its_error():
    errors, sigmas = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        first, second = np.arange(0.0, 40.0, 0.1), np.arange(0.0, 40.0, 0.1) + 0.03
        found = fusion.clock_offset(first, rates(first, 0.0, rng, 0.1), second, rates(second, 0.2, rng, 0.1))
        errors.append(found.offset_s - 0.2)
        sigmas.append(found.sigma_s)
    assert 0.4 < np.std(errors) / np.mean(sigmas) < 2.5


def test_a_robot_that_does_not_turn_tells_no_offset():
    stamps_s = np.arange(0.0, 30.0, 0.1)
    still = np.zeros(stamps_s.size)
    assert fusion.clock_offset(stamps_s, still, stamps_s, still) is None


def test_rates_that_have_nothing_in_common_tell_no_offset():
    rng = np.random.default_rng(0)
    stamps_s = np.arange(0.0, 30.0, 0.1)
    noise = rng.standard_normal((2, stamps_s.size))
    assert fusion.clock_offset(stamps_s, noise[0], stamps_s, noise[1]) is None
