"""An IMU in localisation: it leads where a cloud shows nothing, and is left out where it is wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import gtsam
import numpy as np
import pytest
from cloud_world import base, look
from imu_world import T_BASE_IMU, readings

from slam.config import Config
from slam.config.clouds import CloudOdometryConfig
from slam.localization.odometry import CloudOdometry, OdometryStep
from slam.measurements import ImuReading

CONFIG = Config(cloud_odometry=CloudOdometryConfig(voxel_m=0.2))
BLIND_S = 3.0


def way(time_s: float) -> gtsam.Pose3:
    return base(-1.5 + 0.4 * time_s, 0.5 * np.sin(0.7 * time_s), 0.6 * np.sin(0.8 * time_s))


def driven(odometry: CloudOdometry, heard: Iterable[ImuReading]) -> list[tuple[float, OdometryStep]]:
    """Ten clouds a second, the last two of them blind."""
    steps, next_s = [], 0.0
    for reading in heard:
        odometry.add_imu(reading)
        time_s = reading.stamp_s - 0.01
        if time_s < next_s - 1e-9:
            continue
        next_s, cloud = next_s + 0.1, look(way(time_s), time_s, seed=int(10 * time_s))
        if time_s > BLIND_S:
            cloud = dataclasses.replace(cloud, points_lidar=cloud.points_lidar[:20])
        steps.append((time_s, odometry.add(cloud)[1]))
    return steps


@pytest.mark.parametrize("imu", [True, False])
def test_blind_clouds_are_bridged_as_well_as_the_imu_knows(imu: bool) -> None:
    config = (
        CONFIG
        if imu
        else CONFIG.model_copy(update={"sensors": CONFIG.sensors.model_copy(update={"imu": False})})
    )
    odometry = CloudOdometry(config)
    (before_s, _), (last_s, last) = driven(odometry, readings(way, BLIND_S + 0.22))[-2:]
    assert last_s > BLIND_S and last.moved is not None and not odometry.unfit
    off = gtsam.Pose3.Logmap(way(before_s).between(way(last_s)).between(last.moved.pose))
    sigma_m = np.sqrt(np.diag(last.moved.covariance)[3:].max())
    assert off @ np.linalg.solve(last.moved.covariance, off) < 12.6
    # Without one, a robot in space may have done anything within a tenth of a second.
    assert (sigma_m < 0.03) == imu


def test_an_imu_that_contradicts_the_lidar_is_left_out_and_named() -> None:
    odometry = CloudOdometry(CONFIG)
    wrong = gtsam.Pose3(gtsam.Rot3.Roll(1.5), T_BASE_IMU.translation())
    steps = driven(odometry, readings(way, BLIND_S, stated=wrong))
    assert odometry.unfit.startswith("imu is left out: ")
    # Once, the frame starts again; every other step is that of the lidar.
    assert sum(step.moved is None for _, step in steps) == 2
    for (before_s, _), (time_s, step) in zip(steps[-3:], steps[-2:], strict=False):
        assert step.moved is not None
        truth = way(before_s).between(way(time_s))
        assert np.linalg.norm(truth.between(step.moved.pose).translation()) < 0.02
