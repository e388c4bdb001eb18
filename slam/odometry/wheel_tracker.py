"""Wheel odometry as a guess and as a measurement, never as the truth."""

from __future__ import annotations

import math

import numpy as np

from slam.config.stages import WheelConfig
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2

# Beyond this the last reading is too old to be carried on by its own speed.
LONGEST_EXTRAPOLATION_S = 0.5
# Readings whose stamps coincide or run backward took a time that nobody knows.
_SHORTEST_STEP_S = 0.05
_UNKNOWN_STEP_S = 1.0


class WheelTracker:
    """The newest odometry readings, asked for the pose at a scan's stamp."""

    def __init__(self, config: WheelConfig) -> None:
        self._config = config
        self._stamp_s = math.nan
        self._pose: FloatArray | None = None
        self._twist: FloatArray | None = None

    def add(self, reading: WheelOdometry) -> None:
        """Take the next reading in the order of the log."""
        pose = row_from_pose2(reading.T_odom_base)
        step_s = reading.stamp_s - self._stamp_s
        self._twist = between(self._pose, pose) / step_s if self._pose is not None and step_s > 0.0 else None
        self._pose = pose
        self._stamp_s = reading.stamp_s

    def pose_at(self, stamp_s: float) -> FloatArray | None:
        """Pose (3,) in the odom frame at a stamp at or shortly after the last reading; None before any."""
        ahead_s = stamp_s - self._stamp_s
        if self._pose is None or self._twist is None or not 0.0 < ahead_s < LONGEST_EXTRAPOLATION_S:
            return self._pose
        return compose(self._pose, self._twist * ahead_s)

    def plausible(self, step: FloatArray, step_s: float) -> bool:
        """Whether a robot can move by ``step`` (3,) in that time."""
        time_s = step_s if step_s > _SHORTEST_STEP_S else _UNKNOWN_STEP_S
        return bool(
            math.hypot(step[0], step[1]) <= self._config.greatest_speed_m_s * time_s + self._config.floor_m
            and abs(step[2]) <= self._config.greatest_turn_rad_s * time_s + self._config.floor_rad
        )

    def swing_m(self, step: FloatArray) -> float:
        """Sigma of the way that a turn adds: the base may sit beside the axle by more than the log tells."""
        return self._config.swing_m_per_rad * abs(float(step[2]))

    def covariance(self, step: FloatArray) -> FloatArray:
        """Covariance (3, 3) of a wheel motion ``step`` (3,): floor, and shares of way and turn."""
        config = self._config
        path_m = math.hypot(step[0], step[1])
        turn_rad = abs(float(step[2]))
        sigma_m = config.floor_m + config.distance_share * path_m
        sigma_rad = config.floor_rad + config.turn_share * turn_rad + config.turn_per_m_rad * path_m
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
