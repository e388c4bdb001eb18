"""A gyroscope about the vertical: what it learns of itself, and what it says of turns."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
from imu_world import GYRO_BIAS, T_BASE_IMU, readings
from scripted_tracker import SOME, ScriptedOdometry, motion_at

from fusion.estimation import half_interval
from slam.config.stages import MatchConfig, PredictionConfig, WheelConfig
from slam.measurements import ImuReading, WheelOdometry, pose2_from_row
from slam.odometry.gyro_yaw import GyroMoment, YawGyro
from slam.odometry.motion_tracker import MotionTracker
from slam.odometry.wheel_tracker import WheelTracker

UP = T_BASE_IMU.rotation().unrotate(np.array([0.0, 0.0, 1.0]))
SCALE = 1.02


def heading(time_s: float) -> float:
    """Of a robot that turns to and fro, and more to the left."""
    return float(0.05 * time_s + 0.8 * np.sin(0.35 * time_s))


def rolls(time_s: float) -> gtsam.Pose3:
    """A robot on a floor."""
    place = np.array([np.sin(0.1 * time_s), 0.2 * time_s, 0.0])
    return gtsam.Pose3(gtsam.Rot3.Yaw(heading(time_s)), place)


def said(until_s: float, *, gap: tuple[float, float] = (0.0, 0.0), seed: int = 0) -> list[ImuReading]:
    """Readings two hundredths too large; the log does not show the mounting."""
    return [
        ImuReading(one.stamp_s, SCALE * one.gyro_rad_s, one.specific_force_m_s2)
        for one in readings(rolls, until_s, seed=seed)
        if not gap[0] < one.stamp_s < gap[1]
    ]


def heard(rows: list[ImuReading], learn_until_s: float, seed: int = 0) -> tuple[YawGyro, list[GyroMoment]]:
    """A gyroscope asked ten times a second, and where scans are matched to a milliradian until some time."""
    gyro, moments, rng = YawGyro(), list[GyroMoment](), np.random.default_rng(seed)
    due_s = 0.1
    for one in rows:
        gyro.add(one)
        if one.stamp_s >= due_s:
            moment = gyro.moment(due_s)
            if moment is not None:
                moments.append(moment)
            if due_s <= learn_until_s:
                gyro.learn(moment, heading(due_s) + 1e-3 * rng.standard_normal(), 1e-6)
            due_s += 0.1
    return gyro, moments


def test_bias_and_scale_are_learned_within_what_they_claim() -> None:
    off = []
    for seed in range(3):
        gyro, _ = heard(said(60.0, seed=seed), 60.0, seed)
        bias, scale = gyro._known
        sigmas = np.sqrt(np.diag(gyro._spread))
        true = np.array([SCALE * GYRO_BIAS @ UP, 1.0 - 1.0 / SCALE])
        off.append((np.array([bias, scale]) - true) / sigmas)
        assert half_interval(sigmas[0]) < 1e-3 and half_interval(sigmas[1]) < 4e-3
    assert np.abs(off).max() < 3.5 and np.mean(np.square(off)) < 2.0


def test_a_turn_that_no_scan_saw_is_reported_with_an_honest_variance() -> None:
    gyro, moments = heard(said(80.0), 60.0)
    turn_rad, variance = gyro.turn(moments[-190], moments[-1]) or (0.0, 0.0)
    true = heading(moments[-1].stamp_s) - heading(moments[-190].stamp_s)
    assert abs(turn_rad - true) < 3.0 * np.sqrt(variance) < 0.03
    assert (gyro.turn(moments[-3], moments[-2], chained=True) or (0, 0))[1] > (
        gyro.turn(moments[-3], moments[-2]) or (0, 0)
    )[1]


def test_before_anything_is_learned_the_bias_may_be_large() -> None:
    gyro, moments = heard(said(3.0), 0.0)
    _, variance = gyro.turn(moments[0], moments[10]) or (0.0, 0.0)
    assert np.sqrt(variance) == pytest.approx(0.1, rel=0.2)
    assert not gyro.notes()


def test_across_missing_readings_nothing_is_reported() -> None:
    gyro, moments = heard(said(30.0, gap=(15.0, 17.0)), 30.0)
    inside = [n for n, one in enumerate(moments) if one.stamp_s < 15.0]
    assert gyro.turn(moments[inside[-2]], moments[-1]) is None
    assert gyro.turn(moments[inside[0]], moments[inside[-2]]) is not None
    assert gyro.turn(None, moments[-1]) is None


def test_of_a_scan_that_comes_after_a_later_one_nothing_is_reported() -> None:
    gyro, moments = heard(said(20.0), 10.0)
    assert gyro.turn(moments[-3], moments[-1]) is not None
    assert gyro.turn(moments[-1], moments[-3]) is None
    assert gyro.turn(moments[-1], moments[-1]) is None


def test_an_upside_down_imu_needs_no_mounting() -> None:
    over = gtsam.Pose3(gtsam.Rot3.Roll(np.pi), np.zeros(3))
    rows = [
        ImuReading(one.stamp_s, one.gyro_rad_s, one.specific_force_m_s2)
        for one in readings(rolls, 20.0, T_base_imu=over)
    ]
    gyro, moments = heard(rows, 20.0)
    turn_rad, _ = gyro.turn(moments[20], moments[60]) or (0.0, 0.0)
    assert turn_rad == pytest.approx(heading(6.1) - heading(2.1), abs=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_where_nothing_matches_wheels_that_slip_in_a_turn_follow_the_gyroscope(
    sign: float,
) -> None:
    """Of a gyroscope of the wrong sign the matches have shown what it is worth."""
    odometry, wheels, gyro = ScriptedOdometry(), WheelTracker(WheelConfig()), YawGyro()
    tracker = MotionTracker(odometry, wheels, PredictionConfig(), MatchConfig(), gyro)
    rows, stamps_s = said(39.0), np.arange(1, 381) * 0.1
    turned, number, begun = 0.0, 0, heading(0.1)
    for stamp_s in stamps_s.tolist():
        while number < len(rows) and rows[number].stamp_s <= stamp_s + 0.01:
            one = rows[number]
            gyro.add(ImuReading(one.stamp_s, sign * one.gyro_rad_s, one.specific_force_m_s2))
            number += 1
        step = heading(stamp_s) - heading(stamp_s - 0.1)
        # Without scans one wheel spins, and shows half as much again.
        turned += step if stamp_s <= 34.0 else 1.5 * step
        wheels.add(WheelOdometry(stamp_s, pose2_from_row(np.array([0.0, 0.0, turned]))))
        true = np.array([0.0, 0.0, heading(stamp_s) - begun])
        odometry.answer = lambda _, true=true, on=stamp_s <= 34.0: motion_at(true) if on else None  # type: ignore[misc]
        tracked = tracker.track(SOME, stamp_s)
    slipped = 0.5 * abs(heading(38.0) - heading(34.0))
    off = abs(tracked.pose[2] - true[2])
    assert slipped > 0.5
    assert off < 0.05 * slipped if sign > 0 else off == pytest.approx(slipped)
    assert gyro.unfit == (sign < 0)


def test_who_is_blind_runs_on_no_longer_for_a_gyroscope() -> None:
    """It measures turns and no way: at constant velocity nobody goes on for seconds."""
    odometry, gyro = ScriptedOdometry(), YawGyro()
    tracker = MotionTracker(odometry, None, PredictionConfig(), MatchConfig(), gyro)
    rows, number, ahead = said(15.0), 0, np.zeros(2)
    for stamp_s in (np.arange(1, 141) * 0.1).tolist():
        while number < len(rows) and rows[number].stamp_s <= stamp_s + 0.01:
            gyro.add(rows[number])
            number += 1
        ahead = ahead + 0.05 * np.array([np.cos(heading(stamp_s)), np.sin(heading(stamp_s))])
        true = np.array([*ahead, heading(stamp_s) - heading(0.1)])
        odometry.answer = lambda _, true=true, on=stamp_s <= 4.0: motion_at(true) if on else None  # type: ignore[misc]
        tracked = tracker.track(SOME, stamp_s)
        if stamp_s <= 4.0:
            seen = tracked.pose
    assert not gyro.unfit
    assert float(np.hypot(*(tracked.pose - seen)[:2])) < 1.0
