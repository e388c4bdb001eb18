"""Stamps that belong together, and the offset between two clocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import strategies as st

import fusion

stamps = st.lists(st.floats(0.0, 100.0), max_size=30).map(np.array)


def turns(stamps_s, offset_s, rng, noise=0.01):
    """Turns from stamp to stamp by a clock with an offset; the noise is that of a rate."""
    true, lasted_s = stamps_s - offset_s, np.diff(stamps_s)
    yaw = -0.6 / 0.9 * np.cos(0.9 * true) - 0.4 / 2.3 * np.cos(2.3 * true + 1.0)
    noisy = np.diff(yaw) + noise * lasted_s * rng.standard_normal(lasted_s.size)
    return np.column_stack([stamps_s[:-1], stamps_s[1:]]), noisy


def without(spans_s, turned_rad, begun_s, ended_s):
    """A gap in what a sensor saw."""
    kept = (spans_s[:, 1] < begun_s) | (spans_s[:, 0] > ended_s)
    return spans_s[kept], turned_rad[kept]


@pytest.mark.parametrize("offset", [-0.31, 0.0, 0.0437, 0.62])
@pytest.mark.parametrize("step_s", [0.1, 0.9])
def test_the_offset_is_found_below_a_sample(offset, step_s):
    rng = np.random.default_rng(1)
    first, second = np.arange(0.0, 60.0, step_s), np.arange(0.02, 60.0, 0.033)
    found = fusion.clock_offset(*turns(first, 0.0, rng), *turns(second, offset, rng))
    assert found is not None
    assert abs(found.offset_s - offset) < 0.006
    assert found.correlation > 0.98


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("lasting_s", [0.3, 1.0, 2.0])
def test_a_gap_shows_nothing(seed, lasting_s):
    rng = np.random.default_rng(seed)
    begun_s = rng.uniform(5.0, 30.0)
    first, second = turns(np.arange(0.0, 40.0, 0.1), 0.0, rng), turns(np.arange(0.0, 40.0, 0.07), 0.03, rng)
    gap = begun_s, begun_s + lasting_s
    for found in (
        fusion.clock_offset(*first, *without(*second, *gap), 0.25),
        fusion.clock_offset(*without(*first, *gap), *second, 0.25),
    ):
        assert found is not None
        assert abs(found.offset_s - 0.03) < 0.002


def test_noise_prefers_no_offset():
    """Readings taken as even between their stamps are smoother halfway between."""
    errors = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        first, second = np.arange(0.013, 60.0, 0.1), np.arange(0.0, 60.0, 0.1)
        found = fusion.clock_offset(*turns(first, 0.0, rng), *turns(second, 0.02, rng, 0.1), 0.25)
        errors.append(found.offset_s - 0.02)
    assert abs(np.mean(errors)) < 0.003


def test_a_slipping_wheel_moves_it_little():
    """Slips of half a second report a turn that never was, always to one side."""
    errors = []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        first, (spans_s, turned) = (
            np.arange(0.0, 60.0, 0.25),
            turns(np.arange(0.0, 60.0, 0.05), 0.03, rng, 0.05),
        )
        for begun in rng.integers(0, len(turned) - 10, 4):
            turned[begun : begun + 10] += 0.02
        found = fusion.clock_offset(*turns(first, 0.0, rng), spans_s, turned, 0.25)
        errors.append(found.offset_s - 0.03)
    assert np.sqrt(np.mean(np.square(errors))) < 0.002


def test_the_order_of_the_sensors_gives_the_sign_alone():
    rng = np.random.default_rng(0)
    slow, fast = turns(np.arange(0.0, 60.0, 0.25), 0.0, rng), turns(np.arange(0.0, 60.0, 0.05), 0.03, rng)
    found, reverse = fusion.clock_offset(*slow, *fast, 0.25), fusion.clock_offset(*fast, *slow, 0.25)
    assert reverse.offset_s == -found.offset_s
    assert reverse.sigma_s == found.sigma_s


def test_the_offsets_sigma_is_the_scatter_of_its_error():
    errors, sigmas = [], []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        first, second = np.arange(0.0, 40.0, 0.1), np.arange(0.0, 40.0, 0.1) + 0.03
        found = fusion.clock_offset(*turns(first, 0.0, rng, 0.1), *turns(second, 0.2, rng, 0.1))
        errors.append(found.offset_s - 0.2)
        sigmas.append(found.sigma_s)
    assert 0.4 < np.std(errors) / np.mean(sigmas) < 2.5


def test_a_robot_that_does_not_turn_shows_no_offset():
    spans_s, _ = turns(np.arange(0.0, 30.0, 0.1), 0.0, np.random.default_rng(0))
    still = np.zeros(len(spans_s))
    assert fusion.clock_offset(spans_s, still, spans_s, still) is None


def test_turns_that_have_nothing_in_common_show_no_offset():
    rng = np.random.default_rng(0)
    spans_s, _ = turns(np.arange(0.0, 30.0, 0.1), 0.0, rng)
    noise = 0.1 * rng.standard_normal((2, len(spans_s)))
    assert fusion.clock_offset(spans_s, noise[0], spans_s, noise[1]) is None


def test_turns_that_a_clock_shows_twice_count_once():
    rng = np.random.default_rng(0)
    first, second = (turns(np.arange(0.0, 30.0, 0.1), offset_s, rng) for offset_s in (0.0, 0.2))
    twice = np.concatenate([second[0], second[0][50:]]), np.concatenate([second[1], -second[1][50:]])
    assert fusion.clock_offset(*first, *twice) == fusion.clock_offset(*first, *second)
    assert fusion.clock_offset(*first, *second) is not None
