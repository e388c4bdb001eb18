"""An IMU beside a lidar: gravity, velocity, bridges, straightened turns, and when it is left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from imu_world import GYRO_BIAS, T_BASE_IMU, Way, readings, stands, walk

from slam.matching.upright import Gravity, upright_of
from slam.measurements import FloatArray, ImuReading, PointCloud
from slam.odometry.imu_readings import ImuReadings
from slam.odometry.imu_smoother import noise_of
from slam.odometry.imu_tracker import ImuTracker, UnfitImuError, apart_in_time

MATCHED = np.diag([1e-6] * 3 + [4e-6] * 3)
DOWN = np.array([0.0, 0.0, -1.0])


def tracked(
    way: Way,
    until_s: float,
    seen: Callable[[float], bool] = lambda time_s: True,
    *,
    stated: gtsam.Pose3 = T_BASE_IMU,
    wheels: bool = False,
    scale: float = 1.0,
) -> ImuTracker:
    """Ten poses a second as a lidar matches them, where it sees; the odometry begins level at the first."""
    imu, rng, last = ImuTracker(), np.random.default_rng(1), 0.0
    T_odom_map = way(0.05).inverse()
    for reading in readings(way, until_s, stated=stated):
        imu.add(replace(reading, gyro_rad_s=scale * reading.gyro_rad_s))
        time_s = reading.stamp_s - 0.05
        if time_s < last + 0.1 - 1e-9 or time_s < 0.05:
            continue
        noise = gtsam.Pose3.Expmap(rng.multivariate_normal(np.zeros(6), MATCHED))
        pose = T_odom_map.compose(way(time_s)).compose(noise)
        step = (way(last).between(way(time_s)), 1e-4 * np.eye(6)) if wheels else None
        imu.took(time_s, pose, MATCHED if seen(time_s) else None, None if seen(time_s) else step)
        last = time_s
    return imu


def apart_rad(first: FloatArray, second: FloatArray) -> float:
    return float(np.arccos(np.clip(first @ second, -1.0, 1.0)))


def test_a_walk_shows_gravity_velocity_and_biases() -> None:
    imu = tracked(walk, 8.0)
    state, gravity = imu.state, imu.gravity()
    assert state is not None and gravity is not None
    down = walk(gravity.stamp_s).rotation().unrotate(DOWN)
    assert apart_rad(gravity.down, down) < np.radians(0.2)
    assert apart_rad(gravity.down, down) < 4.0 * gravity.sigma_rad
    assert np.abs(state.bias.gyroscope() - GYRO_BIAS).max() < 1e-3
    ends = [walk(state.stamp_s + dt).compose(T_BASE_IMU).translation() for dt in (-1e-3, 1e-3)]
    velocity = walk(0.05).rotation().unrotate((ends[1] - ends[0]) / 2e-3)
    assert np.linalg.norm(state.velocity_m_s - velocity) < 0.05


def test_who_stands_knows_gravity_only_as_well_as_the_accelerometer() -> None:
    gravity = tracked(stands, 12.0).gravity()
    assert gravity is not None
    # Twenty milligravities, for good: to stand on gives nothing new.
    assert 0.01 < gravity.sigma_rad < 0.04
    assert apart_rad(gravity.down, stands(0.0).rotation().unrotate(DOWN)) < 2.0 * gravity.sigma_rad


def test_who_drives_straight_knows_gravity_no_better_than_who_stands() -> None:
    # Of a direction with two components alike the axes that GTSAM gives it swing by a right angle.
    tilt = gtsam.Rot3.Ypr(0.0, 0.1, 0.1)
    gravity = tracked(lambda time_s: gtsam.Pose3(tilt, time_s * tilt.matrix()[:, 0]), 7.0).gravity()
    assert gravity is not None and 0.01 < gravity.sigma_rad < 0.04


def test_three_seconds_without_a_cloud_are_bridged_and_owned_up_to() -> None:
    imu = tracked(walk, 9.1, lambda time_s: time_s < 6.0)
    spread, state = imu.spread(), imu.state
    assert spread is not None and state is not None
    true = walk(0.05).between(walk(state.stamp_s))
    off = gtsam.Pose3.Logmap(true.between(state.pose.compose(T_BASE_IMU.inverse())))
    way_m = sum(
        float(np.linalg.norm(walk(6.0 + 0.1 * n).between(walk(6.1 + 0.1 * n)).translation()))
        for n in range(30)
    )
    assert np.linalg.norm(off[3:]) < 0.1 * way_m
    assert off @ np.linalg.solve(spread, off) / 6.0 < 5.0
    assert imu.bridged_s == pytest.approx(3.0, abs=0.2)
    notes, unused = imu.outcome()
    assert any("without a match" in note for note in notes) and not unused


def test_a_direction_that_is_open_weighs_nothing_and_the_others_what_they_should() -> None:
    rng = np.random.default_rng(3)
    for _ in range(20):
        open_, turn = rng.standard_normal(6), np.linalg.qr(rng.standard_normal((6, 6)))[0]
        open_ /= np.linalg.norm(open_)
        there = T_BASE_IMU.AdjointMap()
        noise = noise_of(there @ (MATCHED + 1e4 * np.outer(open_, open_)) @ there.T)
        assert np.linalg.norm(noise.whiten(1e-2 * there @ open_)) < 1e-2
        # A unit error in the measured rest, by Woodbury's identity.
        error = 1e-3 * turn[0]
        weak = np.linalg.solve(MATCHED, open_)
        squared = error @ np.linalg.solve(MATCHED, error) - (weak @ error) ** 2 / (1e-4 + weak @ open_)
        assert np.linalg.norm(noise.whiten(there @ error)) == pytest.approx(squared**0.5, rel=1e-3)


def test_wheels_hold_a_long_bridge() -> None:
    imu = tracked(walk, 12.0, lambda time_s: time_s < 4.0, wheels=True)
    state = imu.state
    assert state is not None
    true = walk(0.05).between(walk(state.stamp_s)).translation()
    assert np.linalg.norm(state.pose.compose(T_BASE_IMU.inverse()).translation() - true) < 0.1


def test_turns_that_are_some_percent_too_large_lead_nowhere() -> None:
    def way(time_s: float) -> gtsam.Pose3:
        yaw = 3.2 * np.sin(0.5 * time_s) ** 3
        return gtsam.Pose3(gtsam.Rot3.Yaw(yaw), np.array([0.3 * time_s, 0.2 * np.sin(time_s), 0.0]))

    state = tracked(way, 8.0, scale=1.02).state
    assert state is not None
    seen = way(0.05).between(way(state.stamp_s)).compose(T_BASE_IMU)
    assert np.linalg.norm(gtsam.Rot3.Logmap(seen.between(state.pose).rotation())) < 5e-3


def test_a_wrong_mounting_is_found_out() -> None:
    with pytest.raises(UnfitImuError) as found:
        tracked(walk, 8.0, stated=gtsam.Pose3(gtsam.Rot3.Roll(1.5), np.zeros(3)))
    assert found.value.args[0] == "imu" and "wrong mounting" in found.value.args[1]


def test_forces_of_another_way_are_found_out() -> None:
    imu = ImuTracker()
    with pytest.raises(UnfitImuError, match="forces"):
        for reading in readings(walk, 12.0):
            off = reading.specific_force_m_s2 + np.array([1.5, 0.0, 0.0])
            imu.add(replace(reading, specific_force_m_s2=off))
            if abs(reading.stamp_s * 10.0 - round(reading.stamp_s * 10.0)) < 1e-6 and reading.stamp_s > 0.2:
                imu.took(reading.stamp_s, walk(reading.stamp_s), MATCHED)


def test_readings_with_a_gap_begin_anew() -> None:
    imu, way = ImuTracker(), walk
    for reading in readings(way, 6.0):
        if not 3.0 < reading.stamp_s < 4.0:
            imu.add(reading)
        if abs(reading.stamp_s * 10.0 - round(reading.stamp_s * 10.0)) < 1e-6 and reading.stamp_s > 0.2:
            imu.took(reading.stamp_s, way(reading.stamp_s), MATCHED)
            if reading.stamp_s == pytest.approx(4.1):
                assert imu.state is None
    assert imu.state is not None


def test_a_turn_is_straightened() -> None:
    world = np.random.default_rng(2).uniform(-8.0, 8.0, (400, 3))
    stamp_s, times_s = 4.0, np.linspace(-0.05, 0.05, 400)
    T_base_lidar = gtsam.Pose3(gtsam.Rot3.Yaw(0.7), np.array([0.1, 0.0, 0.3]))
    imu = tracked(walk, 4.1)
    seen = [
        walk(stamp_s + dt).compose(T_base_lidar).transformTo(point)
        for dt, point in zip(times_s, world, strict=True)
    ]
    # The newest state is at 4.0: a cloud is straightened before it is matched.
    cloud = PointCloud(stamp_s, np.array(seen, np.float32), times_s, T_base_lidar)
    imu_before = tracked(walk, 3.96)
    for reading in readings(walk, 4.1):
        if reading.stamp_s >= 3.96:
            imu_before.add(reading)
    straight = imu_before.straightened(cloud, np.zeros(6))
    still = np.array([walk(stamp_s).compose(T_base_lidar).transformTo(point) for point in world])
    assert straight.times_s is None
    assert np.abs(np.array(seen) - still).max() > 0.1
    assert np.abs(straight.points_lidar - still).max() < 0.01
    assert imu.straightened(PointCloud(99.0, cloud.points_lidar, times_s), np.zeros(6)).times_s is not None


def test_noise_is_reported_by_the_readings_of_a_robot_that_moves() -> None:
    held = ImuReadings()
    for reading in readings(walk, 3.0):
        held.add(reading)
    parameters = held.parameters()
    # 2e-3 rad/s and 2e-2 m/s^2 at 200 Hz.
    assert parameters.getGyroscopeCovariance()[0, 0] ** 0.5 == pytest.approx(2e-3 / 200**0.5, rel=0.2)
    assert parameters.getAccelerometerCovariance()[0, 0] ** 0.5 == pytest.approx(2e-2 / 200**0.5, rel=0.2)


def test_what_shares_an_error_counts_once() -> None:
    together = {key: Gravity(0.1 * key, DOWN, 1e-3) for key in range(16)}
    assert apart_in_time(together)[3].sigma_rad == pytest.approx(4e-3)
    apart = {key: Gravity(1e4 * key, DOWN, 1e-3) for key in range(4)}
    assert apart_in_time(apart)[3].sigma_rad == pytest.approx(1e-3)


@pytest.mark.parametrize("down", [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.6, 0.0, -0.8], [0.0, -1.0, 0.0]])
def test_upright(down: list[float]) -> None:
    assert upright_of(np.array(down)).rotate(np.array(down)) == pytest.approx(DOWN, abs=1e-9)


def test_a_reading_that_is_not_later_is_left_out() -> None:
    held = ImuReadings()
    for stamp_s in (0.0, 0.01, 0.01, 0.005, 0.02):
        held.add(ImuReading(stamp_s, np.zeros(3), -9.8 * DOWN))
    assert held.newest_s == 0.02 and held.covers(0.0, 0.02) and not held.covers(0.0, 5.0)
    assert np.allclose(held.mean(0.021, 0.023)[3:], -9.8 * DOWN)  # a mean of nothing was no number


def test_where_a_clock_is_set_back_it_begins_anew() -> None:
    imu = tracked(walk, 3.0)
    assert imu.state is not None
    imu.add(ImuReading(1.0, np.zeros(3), -9.8 * DOWN))
    assert imu.state is None and imu.predicted(3.0) is None
    held = ImuReadings()
    for stamp_s in (6.0, 6.01, 6.02, 1.0, 1.01):
        held.add(ImuReading(stamp_s, np.zeros(3), -9.8 * DOWN))
    assert held.newest_s == 1.01 and held.covers(1.0, 1.01) and not held.covers(6.0, 1.0)
