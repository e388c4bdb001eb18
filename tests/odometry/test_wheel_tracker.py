"""Wheel odometry: carried on for a moment, doubted in proportion, and not believed when it jumps."""

import math
from itertools import pairwise

import gtsam
import numpy as np
import pytest

from slam.config.stages import WheelConfig
from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import FloatArray, WheelOdometry, pose2_from_row
from slam.odometry.clock_learner import Turns
from slam.odometry.wheel_tracker import WheelTracker, thrown_aside

CONFIG = WheelConfig()


def tracker(*readings: tuple[float, float, float, float]) -> WheelTracker:
    """From readings (stamp, x, y, yaw)."""
    wheels = WheelTracker(CONFIG)
    for stamp_s, x, y, yaw in readings:
        wheels.add(WheelOdometry(stamp_s, gtsam.Pose2(x, y, yaw)))
    return wheels


def pose_at(wheels: WheelTracker, stamp_s: float) -> FloatArray:
    pose = wheels.pose_at(stamp_s)
    assert pose is not None
    return pose


def test_nothing_is_known_before_the_first_reading() -> None:
    assert tracker().pose_at(0.0) is None


def test_one_reading_has_no_speed() -> None:
    np.testing.assert_array_equal(pose_at(tracker((1.0, 2.0, 3.0, 0.5)), 1.3), [2.0, 3.0, 0.5])


@pytest.mark.parametrize("yaw", [0.0, 1.1, -2.8])
def test_a_straight_drive_goes_on(yaw: float) -> None:
    heading = np.array([math.cos(yaw), math.sin(yaw)])
    wheels = tracker((10.0, 5.0, -1.0, yaw), (10.1, 5.0 + 0.1 * heading[0], -1.0 + 0.1 * heading[1], yaw))
    expected = [5.0 + 0.3 * heading[0], -1.0 + 0.3 * heading[1], yaw]
    np.testing.assert_allclose(pose_at(wheels, 10.3), expected, atol=1e-9)


def test_a_turn_on_the_spot_goes_on_through_pi() -> None:
    wheels = tracker((0.0, 1.0, 1.0, 3.0), (0.1, 1.0, 1.0, 3.1))
    np.testing.assert_allclose(pose_at(wheels, 0.2), [1.0, 1.0, 3.2 - 2.0 * math.pi], atol=1e-9)


@pytest.mark.parametrize("stamp_s", [0.1, 0.05, -3.0, 0.61, 100.0])
def test_no_extrapolation_backward_or_far(stamp_s: float) -> None:
    wheels = tracker((0.0, 0.0, 0.0, 0.0), (0.1, 0.1, 0.0, 0.0))
    np.testing.assert_array_equal(pose_at(wheels, stamp_s), [0.1, 0.0, 0.0])


def test_a_time_that_is_not_the_logs_own_is_looked_up() -> None:
    """Frames of a late clock are logged after younger readings of the wheels."""
    wheels = tracker((0.0, 0.0, 0.0, 0.0), (0.1, 0.1, 0.0, 0.0), (0.2, 0.1, 0.0, 0.4))
    moment = wheels.moment(0.15, in_order=False)
    assert moment is not None
    np.testing.assert_allclose(moment.pose, [0.1, 0.0, 0.2], atol=1e-9)
    np.testing.assert_array_equal(pose_at(wheels, 0.15), [0.1, 0.0, 0.4])


@pytest.mark.parametrize("second_s", [0.0, -5.0])
def test_stamps_that_stand_or_run_backward_give_no_speed(second_s: float) -> None:
    wheels = tracker((0.0, 0.0, 0.0, 0.0), (second_s, 1.0, 0.0, 0.0))
    np.testing.assert_array_equal(pose_at(wheels, second_s + 0.2), [1.0, 0.0, 0.0])
    # The next reading makes it good again.
    wheels.add(WheelOdometry(second_s + 0.1, gtsam.Pose2(1.1, 0.0, 0.0)))
    np.testing.assert_allclose(pose_at(wheels, second_s + 0.2), [1.2, 0.0, 0.0])


@pytest.mark.parametrize(
    ("step", "step_s", "plausible"),
    [
        ((0.0, 0.0, 0.0), 0.1, True),
        ((0.4, 0.0, 0.1), 0.1, True),
        ((0.0, -0.5, 0.0), 0.1, True),
        ((0.6, 0.0, 0.0), 0.1, False),
        ((-3.0, 4.0, 0.0), 0.9, False),
        ((-3.0, 4.0, 0.0), 1.1, True),
        ((0.0, 0.0, 0.7), 0.1, False),
        ((0.0, 0.0, -0.7), 0.1, False),
        ((0.0, 0.0, -0.5), 0.1, True),
        # A time that nobody knows counts as a second.
        ((2.0, 0.0, 0.0), 0.0, True),
        ((2.0, 0.0, 0.0), -600.0, True),
        ((6.0, 0.0, 0.0), 0.0, False),
        ((6.0, 0.0, 0.0), -600.0, False),
        ((math.nan, 0.0, 0.0), 1.0, False),
    ],
)
def test_what_a_robot_can_do(step: tuple[float, ...], step_s: float, plausible: bool) -> None:
    assert tracker().plausible(np.array(step), step_s) is plausible


def test_the_doubt_grows_with_way_and_turn() -> None:
    wheels = tracker()

    def sigmas(x: float, y: float, yaw: float) -> FloatArray:
        covariance = wheels.covariance(np.array([x, y, yaw]))
        np.testing.assert_array_equal(covariance, np.diag(np.diag(covariance)))
        return np.sqrt(np.diag(covariance))

    floor_m, floor_rad = CONFIG.floor_m, CONFIG.floor_rad
    np.testing.assert_allclose(sigmas(0, 0, 0), [floor_m, floor_m, floor_rad])
    way = floor_m + 5.0 * CONFIG.distance_share
    np.testing.assert_allclose(sigmas(3, -4, 0), [way, way, floor_rad + 5.0 * CONFIG.turn_per_m_rad])
    np.testing.assert_allclose(sigmas(0, 0, -2.0), [floor_m, floor_m, floor_rad + 2.0 * CONFIG.turn_share])


def where(true_s: float) -> FloatArray:
    """A robot that drives in bends."""
    return np.array([0.5 * true_s, 0.4 * math.sin(0.5 * true_s), 1.5 * math.sin(0.7 * true_s)])


def driven(ahead_s: float, *, sorted_by_stamp: bool) -> tuple[WheelTracker, list[tuple[float, FloatArray]]]:
    """A robot whose wheels' clock is ahead, and what was reported of where it is at each scan.

    The readings come in the order of their arrival, or of their stamps.
    """
    wheels, lidar, stated = WheelTracker(CONFIG), Turns(), []
    readings = [(0.1 * n, 0.1 * n + ahead_s, "wheels") for n in range(3200)]
    scans = [(true_s, true_s, "lidar") for true_s in np.arange(0.53, 319.0, 0.73)]
    rng = np.random.default_rng(1)
    for true_s, stamp_s, sensor in sorted(readings + scans, key=lambda one: one[1 if sorted_by_stamp else 0]):
        if sensor == "wheels":
            noisy = where(true_s) + rng.normal(0.0, [1e-4, 1e-4, 1e-3])
            wheels.add(WheelOdometry(stamp_s, pose2_from_row(noisy)))
        else:
            stated.append((true_s, pose_at(wheels, stamp_s)))
            lidar.add(stamp_s, where(true_s)[2] + rng.normal(0.0, 0.001))
            wheels.learn_clock(lidar)
    return wheels, stated


def worst_step(stated: list[tuple[float, FloatArray]]) -> float:
    """Greatest error of a step from scan to scan, metres or radians."""
    return max(
        float(np.abs(between(between(where(begun_s), where(ended_s)), between(a, b))).max())
        for (begun_s, a), (ended_s, b) in pairwise(stated)
    )


@pytest.mark.parametrize("sorted_by_stamp", [False, True])
@pytest.mark.parametrize("ahead_s", [-0.13, 0.13])
def test_wheels_with_another_clock_are_read_at_the_lidars_time(ahead_s: float, sorted_by_stamp: bool) -> None:
    wheels, stated = driven(ahead_s, sorted_by_stamp=sorted_by_stamp)
    assert wheels.clock_was_used
    assert wheels.clock.offset_s == pytest.approx(ahead_s, abs=0.01)
    assert worst_step(stated[:50]) > 0.04
    # Carried on by their speed where the readings of the moment are yet to come, as all are before.
    assert worst_step(stated[-100:]) < 0.025
    # No step is longer because the clock was learned meanwhile.
    assert worst_step(stated) < 1.5 * worst_step(stated[:50])


def test_clocks_that_agree_change_nothing() -> None:
    wheels, _ = driven(0.003, sorted_by_stamp=True)
    assert wheels.clock.known
    assert not wheels.clock_was_used


@pytest.mark.parametrize("again_s", [1e-5, 0.0, -1e-5])
def test_readings_at_about_one_time_show_no_wild_speed(again_s: float) -> None:
    wheels, _ = driven(-0.13, sorted_by_stamp=True)
    now = pose_at(wheels, 319.9)
    wheels.add(WheelOdometry(319.9 - 0.13 + again_s, pose2_from_row(where(319.905))))
    for stamp_s in (319.9, 319.95):
        assert np.hypot(*(pose_at(wheels, stamp_s) - now)[:2]) < 0.1


def test_a_jump_right_after_the_reading_of_a_scan_is_left_out() -> None:
    """A log writes the wheels' pose beside every scan too, a moment before their next reading."""
    wheels = WheelTracker(CONFIG)
    for n in range(20):
        wheels.add(WheelOdometry(0.1 * n, gtsam.Pose2(0.06 * n, 0.0, 0.0)))
    wheels.add(WheelOdometry(1.976, gtsam.Pose2(1.19, 0.0, 0.0)))
    wheels.add(WheelOdometry(2.0, gtsam.Pose2(1.2, 0.0, 3.0)))
    moved = wheels.add(WheelOdometry(2.1, gtsam.Pose2(1.2, 0.0, 3.0).compose(gtsam.Pose2(0.06, 0.0, 0.0))))
    np.testing.assert_allclose(moved, [1.26, 0.0, 0.0], atol=0.01)


def test_a_long_way_may_be_aside_by_what_was_turned_wrongly() -> None:
    """Ten metres ahead: aside by a third of what the whole lever would give, and not ahead."""
    aside = thrown_aside(Motion(np.array([10.0, 0.0, 0.0]), np.diag([0.01, 0.01, 0.04])))
    np.testing.assert_allclose(np.diag(aside), [0.0, 100.0 / 3.0 * 0.04, 0.0], atol=1e-12)
    assert abs(aside[1, 2]) == pytest.approx(0.5 * 10.0 * 0.04)


def test_stamps_that_came_late_are_no_jump() -> None:
    """A reading every 0.4 s, 0.2 m on; one is stamped just before the next."""
    wheels = WheelTracker(CONFIG)
    stamps_s = [0.4 * n for n in range(20)]
    stamps_s[12] = stamps_s[13] - 0.01
    stated = [
        wheels.add(WheelOdometry(at_s, gtsam.Pose2(0.2 * n, 0.0, 0.0))) for n, at_s in enumerate(stamps_s)
    ]
    np.testing.assert_allclose(np.array(stated)[:, 0], 0.2 * np.arange(20), atol=1e-9)
    jump = wheels.add(WheelOdometry(stamps_s[-1] + 0.01, gtsam.Pose2(0.2 * 20 + 3.0, 0.0, 0.0)))
    assert jump[0] < 0.2 * 20 + 0.1
