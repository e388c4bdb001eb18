"""An IMU on the robot of the synthetic log, by its true way."""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from imu_world import readings
from scipy.interpolate import CubicSpline

from slam.estimates import Trajectory
from slam.measurements import ImuReading, Measurement


def imu_of(truth: Trajectory, *, noise: float = 1.0, seed: int = 0) -> list[ImuReading]:
    """Readings of an IMU that rides along a true way (x, y, yaw); its mounting is not stated."""
    first_s, (x, y, yaw) = truth.stamps_s[0], truth.to_planar().T
    way = CubicSpline(truth.stamps_s - first_s, np.column_stack([x, y, np.unwrap(yaw)]))

    def pose(time_s: float) -> gtsam.Pose3:
        return gtsam.Pose3(gtsam.Pose2(*way(time_s)))

    said = readings(pose, float(truth.stamps_s[-1] - first_s), stated=None, noise=noise, seed=seed)
    return [
        ImuReading(one.stamp_s + first_s, one.gyro_rad_s, one.specific_force_m_s2, one.T_base_imu)
        for one in said
    ]


def beside(
    log: list[Measurement],
    said: list[ImuReading],
    change: Callable[[ImuReading], ImuReading] = lambda one: one,
) -> list[Measurement]:
    """A log with an IMU, in the order of true stamps."""
    both = [(one.stamp_s, n, one) for n, one in enumerate(log)]
    both += [(one.stamp_s, -1, change(one)) for one in said]
    return [one for _, _, one in sorted(both, key=lambda entry: entry[:2])]
