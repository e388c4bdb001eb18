"""The velocity of a 3D lidar by its matches: over gaps, after doubts, and where a direction is open."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from slam.estimates import MotionEstimate
from slam.odometry.cloud_velocity import CloudVelocity

AHEAD = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0])
ROLL = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
ARMS_M = 4.0 * np.eye(3)


def match(pose: gtsam.Pose3, weak: np.ndarray | None = None) -> MotionEstimate:
    direction = np.zeros(6) if weak is None else weak
    return MotionEstimate(pose, np.eye(6), 0.9, 0.9, 0.01, True, weak is not None, direction)


def driven(steps: int) -> tuple[CloudVelocity, gtsam.Pose3]:
    velocity, pose = CloudVelocity(), gtsam.Pose3()
    velocity.begin(5.0)
    for n in range(1, steps + 1):
        pose = gtsam.Pose3.Expmap(0.1 * n * AHEAD)
        velocity.learn(pose, 5.0 + 0.1 * n, ARMS_M, match(pose))
    return velocity, pose


def test_it_is_known_after_one_step() -> None:
    fresh, _ = driven(0)
    assert not fresh.known
    velocity, _ = driven(1)
    assert velocity.known
    np.testing.assert_allclose(velocity.twist, AHEAD, atol=1e-9)
    on = velocity.carry_on(velocity.twist, 5.3)
    assert on is not None
    assert on.equals(gtsam.Pose3.Expmap(0.3 * AHEAD), 1e-9)


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_a_cloud_that_comes_twice_or_late_shows_no_speed(late_s: float) -> None:
    velocity, _ = driven(3)
    at_m = 0.3 - late_s
    pose = gtsam.Pose3.Expmap(at_m * AHEAD)
    velocity.learn(pose, 5.3 - late_s, ARMS_M, match(pose))
    np.testing.assert_allclose(velocity.twist, AHEAD, atol=1e-9)
    after = gtsam.Pose3.Expmap(0.41 * AHEAD)
    np.testing.assert_allclose(velocity.to(after, 5.4), (0.41 - at_m) / (0.1 + late_s) * AHEAD, atol=1e-9)


def test_a_clock_that_is_set_back_changes_no_speed() -> None:
    """Three clouds later the clock is where it was: the robot has not gone all that way since then."""
    velocity, _ = driven(3)
    for n in range(4, 12):
        pose = gtsam.Pose3.Expmap(0.1 * n * AHEAD)
        velocity.learn(pose, 4.75 + 0.1 * n, ARMS_M, match(pose))
        np.testing.assert_allclose(velocity.twist, AHEAD, atol=1e-9)


def test_a_gap_shows_no_velocity() -> None:
    velocity, pose = driven(2)
    far = pose.compose(gtsam.Pose3(gtsam.Rot3(), np.array([9.0, 0.0, 0.0])))
    np.testing.assert_allclose(velocity.to(far, 8.0), AHEAD, atol=1e-9)
    assert velocity.carry_on(AHEAD, 8.0) is None


@pytest.mark.parametrize("roll_rad", [0.02, -0.02])
def test_an_open_direction_does_not_gather_speed(roll_rad: float) -> None:
    """Its noise would else lead the next guesses on."""
    velocity, pose = driven(3)
    for n in range(4, 8):
        pose = pose.compose(gtsam.Pose3.Expmap(0.1 * AHEAD + roll_rad * ROLL))
        velocity.learn(pose, 5.0 + 0.1 * n, ARMS_M, match(pose, ROLL))
        # By a twentieth of what this match shows and of what is left of those before.
        assert abs(velocity.twist[0]) <= 0.05 * abs(roll_rad / 0.1) * (n - 3) + 1e-6
        np.testing.assert_allclose(velocity.twist[2:4], AHEAD[2:4], atol=0.05)
    velocity.learn(pose.compose(gtsam.Pose3.Expmap(0.1 * AHEAD + 0.01 * ROLL)), 5.8, ARMS_M, match(pose))
    assert abs(velocity.twist[0]) > 0.05


def test_a_twist_that_changes_evenly_is_reported_as_it_is_at_the_end_of_a_step() -> None:
    velocity, place_m = CloudVelocity(), 0.0
    velocity.begin(5.0)
    for stamp_s, step_s in ((5.1, 0.1), (5.3, 0.2)):
        begun, place_m = place_m, 3.0 * (stamp_s - 5.0) ** 2
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([place_m, 0.0, 0.0]))
        mean = (place_m - begun) / step_s
        assert velocity.to(pose, stamp_s)[3] == pytest.approx(mean)
        assert velocity.at(pose, stamp_s)[3] == pytest.approx(mean if stamp_s == 5.1 else 6.0 * 0.3)
        velocity.learn(pose, stamp_s, ARMS_M, match(pose))
    assert velocity.at(pose, 9.0) == pytest.approx(velocity.twist)


@pytest.mark.parametrize("rotated", [False, True])
def test_a_changing_twist_misplaces_a_cloud_by_what_its_points_are_off_on_average(rotated: bool) -> None:
    velocity, times_s = CloudVelocity(), np.linspace(-0.05, 0.05, 101)
    before, spin, surge = np.array([0.0, 0.0, 0.2, 8.0, 0.0, 0.0]), 3.0, 4.0

    def way(time_s: float) -> gtsam.Pose3:
        """On a line and about its own axis, both ever faster."""
        yaw = before[2] * time_s + 0.5 * spin * time_s**2
        return gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.array([0.0, 0.0, 8.0 * time_s + 0.5 * surge * time_s**2]))

    velocity.begin(0.0)
    for stamp_s in (0.1, 0.2):
        velocity.learn(way(stamp_s), stamp_s, ARMS_M, match(way(stamp_s)))
    velocity.rotated = rotated
    off = velocity.misplaced(way(0.3), 0.3, times_s)
    expected = 0.5 * np.mean(times_s**2) * np.array([0.0, 0.0, 0.0 if rotated else spin, 0.0, 0.0, surge])
    assert off == pytest.approx(expected, rel=0.1, abs=1e-6)
    assert not CloudVelocity().misplaced(way(0.3), 0.3, times_s).any()


def test_a_given_twist_is_that_of_the_first_pose() -> None:
    """A robot that begins to turn: the mean of its first step is halfway between both ends."""
    velocity = CloudVelocity(AHEAD)
    velocity.begin(5.0)
    faster = AHEAD * [1.0, 1.0, 3.0, 1.0, 1.0, 1.0]
    after = gtsam.Pose3.Expmap(0.1 * 0.5 * (AHEAD + faster))
    np.testing.assert_allclose(velocity.at(after, 5.1), faster, atol=1e-9)
