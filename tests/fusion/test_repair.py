"""Bumps, veils at edges, and things that must stay, on curves written by hand."""

from __future__ import annotations

import numpy as np
import prism_world as world
from hypothesis import given, settings
from hypothesis import strategies as st

import fusion
from fusion.repair import replace_readings, smooth_outliers
from fusion.reprojection import smooth, without_bumps

MEASURED, FILLED, INTERPOLATED, HOLE, AVERAGED = fusion.Provenance
EPS = 0.025


def repair(own, other, eps=EPS, burr=4, trust=0.5):
    own, other = (np.array(curve, dtype=np.float32) for curve in (own, other))
    return replace_readings(own, other, eps, burr, trust)


def edge(fore=1.2, back=3.0, at=20, count=40):
    """A nearer surface, and a farther one from a sample on."""
    return np.where(np.arange(count) < at, fore, back).astype(np.float32)


@settings(max_examples=40, deadline=None)
@given(st.floats(0.15, 0.85), st.booleans(), st.booleans())
def test_a_reading_that_hangs_in_the_air_at_an_edge_is_replaced(share, on_fore, back_to_front):
    truth = edge()
    own = truth.copy()
    at = 19 if on_fore else 20
    own[at] = 1.2 + share * 1.8
    if back_to_front:
        truth, own, at = truth[::-1].copy(), own[::-1].copy(), 39 - at
    ranges, source = repair(own, truth)
    assert source[at] == FILLED and ranges[at] == truth[at]
    assert (np.delete(source, at) == AVERAGED).all()


def test_a_reading_in_the_air_is_kept_where_the_camera_sees_something_there():
    truth = edge()
    own = truth.copy()
    own[20] = 2.0
    other = truth.copy()
    other[21] = 2.0  # a sample aside
    assert repair(own, other)[1][20] == MEASURED


def test_a_reading_in_the_air_is_kept_without_a_surface_that_both_see_beside_it():
    truth = edge()
    own = truth.copy()
    own[20] = 2.0
    other = np.full(40, np.nan)
    other[20] = 3.0  # alone
    assert repair(own, other)[1][20] == MEASURED


def test_a_reading_in_the_air_is_kept_where_the_camera_sees_a_thin_thing_aside():
    own = np.full(40, 3.0, np.float32)
    own[15:19] = 1.5
    own[19] = 2.2
    other = np.full(40, 3.0, np.float32)
    other[16:20] = 1.5  # moved by a beam
    ranges, source = repair(own, other)
    assert source[19] == MEASURED and ranges[19] == own[19]
    other[15] = 1.5  # not moved, only wider
    assert repair(own, other)[1][19] == FILLED


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 12), st.floats(0.1, 2.5), st.integers(5, 28), st.floats(0.3, 2.9))
def test_what_stands_before_its_neighbours_never_disappears(width, before, at, edge_at):
    truth = edge(fore=3.0, back=3.0)
    own = truth.copy()
    own[at : at + width] -= np.float32(before)
    ranges, source = repair(own, truth)
    kept = slice(at, at + width)
    assert np.abs(ranges[kept] - own[kept]).max() < 0.1
    assert not np.isin(source[kept], (FILLED, INTERPOLATED)).any()


@settings(max_examples=60, deadline=None)
@given(st.integers(2, 6), st.floats(1.3, 2.9))
def test_a_thing_of_several_beams_between_two_surfaces_never_disappears(width, far):
    own = edge()
    own[20 : 20 + width] = far
    ranges, _ = repair(own, edge())
    assert (np.abs(ranges[20 : 20 + width] - far) < 0.1).all()


def test_a_bump_behind_a_whole_surface_is_put_on_to_it():
    own = np.full(40, 2.0, np.float32)
    own[10:13] = 2.3
    ranges, source = repair(own, np.full(40, 2.0))
    assert (source[10:13] == FILLED).all() and (ranges[10:13] == 2.0).all()
    own[10:15] = 2.3  # wider: consistent with itself
    assert (repair(own, np.full(40, 2.0))[1][10:15] == MEASURED).all()


def test_a_mean_moves_no_reading_far():
    own, other = np.full(40, 4.0, np.float32), np.full(40, 4.07, np.float32)
    ranges, source = repair(own, other, trust=0.9)
    assert (source == MEASURED).all() and (ranges == own).all()
    assert (repair(own, other, trust=0.5)[1] == AVERAGED).all()


def wall(count=41, distance=2.0, step=0.006):
    return (distance / np.cos(0.4 + step * np.arange(count))).astype(np.float32)


def calmed(ranges, step=0.006, noise=0.005):
    steady = smooth(without_bumps(ranges, step, 1, 4, 0.04), step, 4, 0.04)
    result, source = ranges.copy(), np.zeros(ranges.size, np.uint8)
    smooth_outliers(result, steady, source, 3.3 * noise)
    return result, source


def test_corners_are_not_rounded():
    for pose in world.POSES:
        scan = world.lidar(pose)
        ranges, source = calmed(scan.ranges_m, scan.step_rad)
        assert np.array_equal(ranges, scan.ranges_m) and (source == MEASURED).all()


def test_what_lies_behind_its_own_noisy_wall_is_put_back_and_what_stands_before_is_kept():
    rng = np.random.default_rng(3)
    truth = wall(distance=4.0)
    noisy = (truth * (1.0 + 0.02 * rng.standard_normal(41))).astype(np.float32)
    noisy[20] = truth[20] * 1.07
    ranges, source = calmed(noisy)
    assert source[20] == INTERPOLATED and abs(ranges[20] - truth[20]) < 0.1
    noisy[20] = truth[20] * 0.93
    assert calmed(noisy)[1][20] == MEASURED
