"""What wheels leave out, what a metre of theirs is, and what they say along a bare corridor."""

import math
from typing import Any

import gtsam
import numpy as np
import pytest

from slam.config.stages import GraphConfig, WheelConfig
from slam.graph.edge import EdgeKind
from slam.mapper.planar_chain import edges_of
from slam.matching.motion import Motion
from slam.matching.planar import between, compose, wrap
from slam.measurements import WheelOdometry, pose2_from_row
from slam.odometry.wheel_tracker import WheelTracker, thrown_aside

SPEED_M_S, PERIOD_S = 0.5, 0.1


def driven(tracker: WheelTracker, count: int = 40) -> tuple[float, float]:
    """Straight ahead; stamp and x of the last reading."""
    for n in range(count):
        tracker.add(reading(n * PERIOD_S, n * PERIOD_S * SPEED_M_S))
    return (count - 1) * PERIOD_S, (count - 1) * PERIOD_S * SPEED_M_S


def reading(stamp_s: float, x_m: float, yaw_rad: float = 0.0) -> WheelOdometry:
    return WheelOdometry(stamp_s, gtsam.Pose2(x_m, 0.0, yaw_rad))


def test_a_heading_that_jumps_turns_nothing() -> None:
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker)
    pose = tracker.add(reading(stamp_s + PERIOD_S, x_m + PERIOD_S * SPEED_M_S, 2.0))
    np.testing.assert_allclose(pose, [x_m + PERIOD_S * SPEED_M_S, 0.0, 0.0], atol=1e-9)


@pytest.mark.parametrize("goes_on", [False, True])
@pytest.mark.parametrize(("ahead_m", "turned_rad"), [(1.2, 0.0), (0.2, 0.6)])
def test_what_a_robot_does_for_one_reading_only_is_no_motion(
    ahead_m: float, turned_rad: float, goes_on: bool
) -> None:
    """Twice a second: 2.4 m/s, or 1.2 rad/s, of a robot that so far went 0.4 m/s and turned 0.1 rad/s."""
    tracker, odom, true = WheelTracker(WheelConfig()), np.zeros(3), np.zeros(3)
    usual, jump = np.array([0.2, 0.0, 0.05]), np.array([ahead_m, 0.0, turned_rad])
    for n in range(260):
        step = jump if n == 250 or (goes_on and n > 250) else usual
        odom = compose(odom, step)
        true = compose(true, step if goes_on else usual)
        pose = tracker.add(WheelOdometry(0.5 * n, pose2_from_row(odom)))
        tracker.add(WheelOdometry(0.5 * n + 0.1, pose2_from_row(odom)))  # scan lines carry the last reading
    np.testing.assert_allclose(between(true, pose), np.zeros(3), atol=0.05)


@pytest.mark.parametrize(("repeated_s", "guessed_m"), [(4.0, 2.0), (40.0, 2.5)])
def test_readings_that_go_on_repeating_show_that_it_stands(repeated_s: float, guessed_m: float) -> None:
    """Carried for a while, and then left standing: it is as uncertain as if it had gone on."""
    tracker = WheelTracker(WheelConfig())
    begun_s, x_m = driven(tracker)
    begun = tracker.moment(begun_s)
    for n in range(1, round(repeated_s / PERIOD_S) + 1):
        tracker.add(reading(begun_s + n * PERIOD_S, x_m))
    ended, silent = (tracker.moment(begun_s + repeated_s + later_s) for later_s in (0.0, 2.0))
    assert begun is not None and ended is not None and silent is not None
    assert ended.pose[0] - x_m == pytest.approx(guessed_m, abs=0.1)
    if repeated_s > 5.0:
        assert silent.pose[0] == pytest.approx(ended.pose[0]), "a silence does not set it going again"
    assert ended.guessed_m == pytest.approx(repeated_s * SPEED_M_S, abs=0.1)


@pytest.mark.parametrize(("times", "sigma_m"), [(1.0, 0.0), (2.5, 0.7)])
def test_wheels_that_run_faster_than_usual_may_have_spun(times: float, sigma_m: float) -> None:
    """For one second: it is believed, and as uncertain as what is too much."""
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker, 300)
    begun = tracker.moment(stamp_s)
    for _ in range(10):
        stamp_s, x_m = stamp_s + PERIOD_S, x_m + times * PERIOD_S * SPEED_M_S
        pose = tracker.add(reading(stamp_s, x_m))
    ended = tracker.moment(stamp_s)
    assert begun is not None and ended is not None and pose[0] == pytest.approx(x_m)
    on_top = tracker.on_top(between(begun.pose, ended.pose), begun, ended)
    assert math.sqrt(on_top[0, 0]) == pytest.approx(sigma_m, abs=0.05)


@pytest.mark.parametrize(("counted_m", "guessed_m"), [(0.0, 2.0), (2.0, 0.0)])
def test_a_way_that_was_not_counted_is_a_guess(counted_m: float, guessed_m: float) -> None:
    """Four seconds without a reading; what they count of it is believed."""
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker)
    begun = tracker.moment(stamp_s)
    tracker.add(reading(stamp_s + 4.0, x_m + counted_m))
    ended = tracker.moment(stamp_s + 4.0)
    assert begun is not None and ended is not None
    assert ended.guessed_m == pytest.approx(guessed_m)
    np.testing.assert_allclose(ended.pose - begun.pose, [2.0, 0.0, 0.0], atol=1e-9)
    on_top = tracker.on_top(np.array([2.0, 0.0, 0.0]), begun, ended)
    assert on_top[0, 0] == pytest.approx(guessed_m**2)


@pytest.mark.parametrize("jump_rad", [0.0, 1.0])
def test_readings_that_only_repeat_the_last_one_count_nothing(jump_rad: float) -> None:
    """Scan lines carry the last reading: the robot goes on, though some come at once and all are the same.

    Meanwhile the heading may jump.
    """
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker)
    tracker.add(reading(stamp_s + 0.05, x_m))
    for later_s in (0.7, 1.4, 2.0):
        pose = tracker.add(reading(stamp_s + later_s, x_m, jump_rad))
    np.testing.assert_allclose(pose, [x_m + 2.0 * SPEED_M_S, 0.0, 0.0], atol=1e-9)
    onward = gtsam.Pose2(x_m, 0.0, jump_rad) * gtsam.Pose2(PERIOD_S * SPEED_M_S, 0.0, 0.0)
    pose = tracker.add(WheelOdometry(stamp_s + 2.0 + PERIOD_S, onward))
    np.testing.assert_allclose(pose[0], x_m + (2.0 + PERIOD_S) * SPEED_M_S, atol=1e-9)
    assert tracker._gaps.guessed_m == pytest.approx(2.0 * SPEED_M_S)


def test_readings_that_come_as_ever_after_a_silence_and_repeat_are_true() -> None:
    """Two seconds without a reading, in which it can have stopped; then it stands for ten."""
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker)
    for n in range(100):
        tracker.add(reading(stamp_s + 2.0 + n * PERIOD_S, x_m))
    assert tracker._gaps.guessed_m == pytest.approx(2.0 * SPEED_M_S, abs=2.0 * PERIOD_S * SPEED_M_S)


def test_a_driver_that_speaks_only_while_it_moves_goes_nowhere_in_a_stop() -> None:
    """It brakes at 1 m/s^2, says nothing for a minute, and drives on."""
    tracker = WheelTracker(WheelConfig())
    stamp_s, x_m = driven(tracker)
    for speed_m_s in np.arange(SPEED_M_S - PERIOD_S, 0.0, -PERIOD_S):
        stamp_s, x_m = stamp_s + PERIOD_S, x_m + (speed_m_s - 0.5 * PERIOD_S) * PERIOD_S
        tracker.add(reading(stamp_s, x_m))
    for later_s in (20.0, 60.0):
        moment = tracker.moment(stamp_s + later_s)
        assert moment is not None and moment.guessed_m == 0.0
        assert moment.pose[0] == pytest.approx(x_m)
    assert tracker.add(reading(stamp_s + 60.0, x_m + 0.01))[0] == pytest.approx(x_m + 0.01)


def test_between_two_readings_the_wheels_show_however_far_apart_they_are() -> None:
    """A lidar that lags asks for what was, and both readings are known."""
    tracker = WheelTracker(WheelConfig())
    for n in range(3):
        tracker.add(reading(n * 0.9, n * 0.45))
    tracker._ahead_s = -0.1
    assert tracker._read_at(1.7, by_stamp=True)[0] == pytest.approx(0.85)


def test_a_heading_that_goes_wrong_throws_the_rest_of_the_way_aside() -> None:
    """Once on each of many ways, anywhere."""
    step, rng, sigma_rad = np.array([3.0, 4.0, 1.0]), np.random.default_rng(0), 0.01
    errors = []
    for _ in range(4000):
        share, error_rad = rng.random(), sigma_rad * rng.standard_normal()
        turn = np.append((1.0 - share) * step[:2], error_rad)
        errors.append(between(step, compose(turn, np.append(share * step[:2], step[2]))))
    known = np.diag([0.0, 0.0, sigma_rad**2])
    expected = known + thrown_aside(Motion(step, known))
    np.testing.assert_allclose(np.cov(np.array(errors).T), expected, atol=0.08 * expected.max())


def test_a_robot_that_stood_still_goes_nowhere_in_a_gap() -> None:
    tracker = WheelTracker(WheelConfig())
    for n in range(40):
        tracker.add(reading(n * PERIOD_S, 1.0))
    tracker.add(reading(60.0, 1.0))
    ended = tracker.moment(60.0)
    assert ended is not None and ended.guessed_m == 0.0
    np.testing.assert_allclose(ended.pose, [1.0, 0.0, 0.0], atol=1e-9)


def test_the_scale_is_learned_and_a_lost_sign_is_not() -> None:
    tracker = WheelTracker(WheelConfig())
    for _ in range(200):
        tracker.learn_scale(np.array([0.5, 0.0, 0.0]), np.array([-0.5, 0.0, 0.0]))
    assert tracker._scale[0] == 1.0
    for _ in range(200):
        scaled = np.array([0.5 * tracker._scale[0], 0.0, 0.0])
        tracker.learn_scale(scaled, np.array([0.51, 0.0, 0.0]))
    assert tracker._scale.tolist() == pytest.approx([1.02, 1.02, 1.0], abs=1e-3)


def test_what_a_larger_wheel_turns_is_learned_and_reported_where_nothing_is_matched() -> None:
    tracker, rng = WheelTracker(WheelConfig()), np.random.default_rng(3)
    stated, true, asked = np.zeros(3), np.zeros(3), list[tuple[Any, Any]]()
    for n in range(900):
        turn_rad = 0.05 * math.sin(0.1 * n)
        # A larger right wheel, and one that spins now and then.
        slip_rad = 0.3 if n % 50 == 7 else 0.0
        stated = compose(stated, np.array([0.05, 0.0, turn_rad - 0.1 * 0.05 + slip_rad]))
        true = compose(true, np.array([0.05, 0.0, turn_rad]))
        tracker.add(WheelOdometry(n * PERIOD_S, pose2_from_row(stated)))
        asked.append((tracker.moment(n * PERIOD_S), true))
        if 0 < n < 600:
            step = tracker.motion(asked[-2][0], asked[-1][0], PERIOD_S)
            assert step is not None
            noise = np.array([0.0, 0.0, 0.003 * rng.standard_normal()])
            tracker.learn_scale(step, between(asked[-2][1], true) + noise)
    assert tracker._yaw_rad_per_m == pytest.approx(0.1, abs=0.01)
    begun, ended = asked[600], asked[-1]
    step = tracker.motion(begun[0], ended[0], 300 * PERIOD_S)
    assert step is not None
    # Mended are 1.5 rad that the larger wheel turns, and 1.8 that it spins, faster than the robot ever turns.
    assert abs(wrap(step[2] - between(begun[1], ended[1])[2])) < 0.15


def test_in_a_corridor_way_and_turn_of_the_wheels_are_two_edges() -> None:
    wheels = Motion(np.array([0.5, 0.0, 2.0]), np.eye(3) * 1e-4)
    match = Motion(np.array([0.5, 0.0, 0.0]), np.diag([900.0, 1e-4, 1e-4]))
    whole, parts = (
        [
            edge
            for edge in edges_of(1, match.pose, match, wheels, [], GraphConfig(), match_open=open_)
            if edge.kind is EdgeKind.WHEEL
        ]
        for open_ in (False, True)
    )
    assert len(whole) == 1 and len(parts) == 2
    far, turn = (np.diag(edge.covariance) for edge in parts)
    assert far[0] < 1e-3 and far[2] > 9.0
    assert turn[0] >= 1.0 and turn[2] < 1e-3
    assert not any(edge.trusted for edge in parts)
