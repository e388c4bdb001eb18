"""What an IMU says on a way that is known as a function of time."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import gtsam
import numpy as np

from slam.measurements import GRAVITY_M_S2, FloatArray, ImuReading

Way = Callable[[float], gtsam.Pose3]
RATE_HZ = 200.0
T_BASE_IMU = gtsam.Pose3(gtsam.Rot3.Ypr(0.3, 0.1, 0.05), np.array([0.05, 0.02, 0.2]))
GYRO_BIAS, FORCE_BIAS = np.array([0.003, -0.004, 0.002]), np.array([0.03, -0.04, 0.02])
_STEP_S, _UP = 1e-3, np.array([0.0, 0.0, GRAVITY_M_S2])


def walk(time_s: float) -> gtsam.Pose3:
    """A lidar in the hand of somebody who walks an ellipse, ``T_map_base``."""
    turn = gtsam.Rot3.Ypr(
        0.4 * time_s + 0.15 * np.sin(1.3 * time_s),
        0.06 * np.sin(2.7 * time_s + 0.5),
        0.08 * np.sin(2.1 * time_s) + 0.03 * np.sin(9.0 * time_s + 1.0),
    )
    up_m = 1.2 + 0.04 * np.sin(9.0 * time_s)
    return gtsam.Pose3(turn, np.array([1.6 * np.sin(0.4 * time_s), -1.4 * np.cos(0.4 * time_s), up_m]))


def stands(time_s: float) -> gtsam.Pose3:
    """A robot that stands on a slope."""
    return gtsam.Pose3(gtsam.Rot3.Ypr(0.5, 0.1, -0.2), np.array([1.0, 0.5, 0.0]))


def felt(way: Way, time_s: float, T_base_imu: gtsam.Pose3 = T_BASE_IMU) -> tuple[FloatArray, FloatArray]:
    """Turn rate and specific force (3,) of a perfect IMU."""
    before, here, after = (way(time_s + k * _STEP_S).compose(T_base_imu) for k in (-1, 0, 1))
    rate = gtsam.Rot3.Logmap(before.rotation().between(after.rotation())) / (2.0 * _STEP_S)
    bent = (before.translation() - 2.0 * here.translation() + after.translation()) / _STEP_S**2
    return np.asarray(rate), np.asarray(here.rotation().unrotate(bent + _UP))


def readings(
    way: Way,
    until_s: float,
    *,
    T_base_imu: gtsam.Pose3 = T_BASE_IMU,
    stated: gtsam.Pose3 | None = T_BASE_IMU,
    seed: int = 0,
    noise: float = 1.0,
) -> Iterator[ImuReading]:
    """With noise and biases; ``stated`` is the mounting that the log shows."""
    rng = np.random.default_rng(seed)
    for n in range(int(until_s * RATE_HZ)):
        rate, force = felt(way, n / RATE_HZ, T_base_imu)
        rate = rate + noise * (GYRO_BIAS + 2e-3 * rng.standard_normal(3))
        force = force + noise * (FORCE_BIAS + 2e-2 * rng.standard_normal(3))
        yield ImuReading(n / RATE_HZ, rate, force, stated)
