"""Following a path: exact arcs, limits, arrival."""

from __future__ import annotations

import math

import numpy as np
import pytest

from slam.simulation.steering import STEP_S, DriveLimits, advance, follow_path

LIMITS = DriveLimits()


def test_an_arc_is_that_of_a_circle() -> None:
    x, y, yaw = advance(0.0, 0.0, 0.0, 0.5, 0.25, math.pi / 0.5)
    assert (x, y, yaw) == pytest.approx((2.0, 2.0, 0.5 * math.pi))
    assert advance(1.0, 2.0, 0.5 * math.pi, 0.5, 0.0, 2.0) == pytest.approx((1.0, 3.0, 0.5 * math.pi))


def test_two_half_arcs_are_the_whole() -> None:
    whole = advance(0.3, -0.2, 1.0, 0.4, -0.7, 1.0)
    assert advance(*advance(0.3, -0.2, 1.0, 0.4, -0.7, 0.4), 0.4, -0.7, 0.6) == pytest.approx(whole)


def there_and_back() -> np.ndarray:
    out = np.column_stack([np.arange(0.0, 4.0, 0.04), np.zeros(100)])
    return np.concatenate([out, out[::-1]])


def test_a_dead_end_is_left_by_turning_round_within_all_limits() -> None:
    path = there_and_back()
    poses, twists = follow_path(path, np.ones(len(path)), 2.0, LIMITS, 0.3, 300.0, closed=False)
    assert len(poses) * STEP_S < 100.0
    assert np.hypot(*(poses[-1, :2] - path[-1])) < 0.15
    assert poses[:, 0].max() > 3.6
    assert np.abs(poses[:, 1]).max() < 0.25
    assert twists[:, 0].min() >= 0.0
    assert twists[:, 0].max() <= LIMITS.speed_m_s + 1e-12
    assert np.abs(twists[:, 1]).max() <= LIMITS.turn_rate_rad_s + 1e-12
    change = np.abs(np.diff(twists, axis=0, prepend=[[0.0, 0.0]])) / STEP_S
    assert (
        change.max(axis=0) <= [LIMITS.acceleration_m_s2 + 1e-9, LIMITS.turn_acceleration_rad_s2 + 1e-9]
    ).all()
    assert twists[-1].tolist() == [0.0, 0.0]


def test_poses_follow_from_the_twists() -> None:
    path = there_and_back()
    poses, twists = follow_path(path, np.ones(len(path)), 0.0, LIMITS, 0.3, 20.0, closed=True)
    for index in (0, 100, 500, 900):
        assert advance(*poses[index], *twists[index], STEP_S) == pytest.approx(tuple(poses[index + 1]))


def test_a_closed_path_is_driven_until_the_time_is_up() -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 200, endpoint=False)
    ring = 2.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    poses, twists = follow_path(ring, np.ones(200), 0.5 * math.pi, LIMITS, 0.3, 90.0, closed=True)
    assert len(poses) == round(90.0 / STEP_S) + 1
    assert np.abs(np.hypot(poses[:, 0], poses[:, 1]) - 2.0).max() < 0.1
    assert poses[-1, 2] > 2.0 * 2.0 * math.pi
    assert twists[-1, 0] > 0.4
