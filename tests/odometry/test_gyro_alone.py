"""An IMU without accelerations beside a 3D lidar: it knows turns, and nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import gtsam
import numpy as np
from imu_world import GYRO_BIAS, readings, stands, walk

from slam.measurements import FloatArray, ImuReading, PointCloud
from slam.odometry.cloud_velocity import CloudVelocity
from slam.odometry.imu_tracker import ImuTracker

MATCHED = np.diag([1e-6] * 3 + [4e-6] * 3)
T_BASE_LIDAR = gtsam.Pose3(gtsam.Rot3.Ypr(0.5, 0.0, 0.1), np.array([0.2, 0.1, 0.4]))
TWIST = np.array([0.0, 0.0, 0.9, 7.0, 0.3, 0.0])


def gyro(until_s: float, *, noise: float = 1.0) -> Iterator[ImuReading]:
    for one in readings(walk, until_s, noise=noise):
        yield replace(one, specific_force_m_s2=np.zeros(3))


def tracked(until_s: float) -> ImuTracker:
    imu = ImuTracker()
    for reading in gyro(until_s):
        imu.add(reading)
        tenths = 10.0 * reading.stamp_s
        if abs(tenths - round(tenths)) < 1e-6 and reading.stamp_s > 0.2:
            imu.took(reading.stamp_s, walk(reading.stamp_s), MATCHED)
    return imu


def test_turns_and_their_bias_are_known_but_no_pose_and_no_gravity() -> None:
    imu = tracked(8.045)
    turned, state = imu.turned(8.04), imu.state
    assert turned is not None and state is not None
    assert np.linalg.norm(gtsam.Rot3.Logmap(walk(8.04).rotation().between(turned))) < 2e-3
    assert np.abs(state.bias.gyroscope() - GYRO_BIAS).max() < 1e-3
    assert imu.predicted(8.04) is None and imu.spread() is None and imu.gravity() is None
    notes, unused = imu.outcome()
    assert any("gyroscope alone" in note for note in notes) and not unused


def test_the_second_cloud_is_turned_too() -> None:
    imu = ImuTracker()
    for one in readings(walk, 0.4, noise=0.0):
        imu.add(replace(one, specific_force_m_s2=np.zeros(3)))
    imu.took(0.2, walk(0.2), MATCHED)
    turned = imu.turned(0.35)
    assert imu.state is None and turned is not None
    assert np.linalg.norm(gtsam.Rot3.Logmap(walk(0.35).rotation().between(turned))) < 1e-3


def test_who_stands_exactly_still_is_followed() -> None:
    imu = ImuTracker()
    for one in readings(stands, 3.0, noise=0.0):
        imu.add(replace(one, specific_force_m_s2=np.zeros(3)))
        if round(200.0 * one.stamp_s) % 20 == 0:
            imu.took(one.stamp_s, gtsam.Pose3(), MATCHED)
    turned = imu.turned(2.99)
    assert turned is not None and np.linalg.norm(gtsam.Rot3.Logmap(turned)) < 1e-6


def test_the_way_within_a_cloud_is_left_to_the_match() -> None:
    """What the gyroscope has turned, and then the velocity moves, is straight: here at 7 m/s in a corner."""

    def way(time_s: float) -> gtsam.Pose3:
        return gtsam.Pose3.Expmap(TWIST * time_s)

    imu = ImuTracker()
    for one in readings(way, 0.4, noise=0.0):
        imu.add(replace(one, specific_force_m_s2=np.zeros(3)))
    rng = np.random.default_rng(2)
    true: FloatArray = rng.uniform(-20.0, 20.0, (500, 3))
    times_s, middle = rng.uniform(-0.05, 0.05, 500), way(0.2).compose(T_BASE_LIDAR)
    seen = [
        way(0.2 + time_s).compose(T_BASE_LIDAR).inverse().transformFrom(middle.transformFrom(point))
        for point, time_s in zip(true, times_s, strict=True)
    ]
    cloud = PointCloud(0.2, np.array(seen, np.float32), times_s, T_BASE_LIDAR)
    turned, velocity = imu.straightened(cloud, TWIST), CloudVelocity(TWIST)
    velocity.rotated = True
    left = velocity.at(gtsam.Pose3(), 0.2)
    assert turned.times_s is times_s and not left[:3].any() and left[3:].tolist() == TWIST[3:].tolist()
    moved = times_s[:, None] * (left[3:] @ T_BASE_LIDAR.rotation().matrix())
    assert np.abs(turned.points_lidar + moved - true).max() < 2e-3
    assert np.abs(turned.points_lidar - true).max() > 0.3
