"""Wheel odometry as a guess and as a measurement, never as the truth."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.config.stages import WheelConfig
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2
from slam.odometry.wheel_gaps import LONGEST_EXTRAPOLATION_S, WheelGaps

# Readings whose stamps coincide or run backward took a time that nobody knows.
_SHORTEST_STEP_S = 0.05
_UNKNOWN_STEP_S = 1.0
# Tyres are not further from what they are taken for than this.
_SCALE_SHARE = 0.2
# Sigma of a robot's turn over a metre that nobody saw, radians.
_TURN_PER_M = 0.5


@dataclass(frozen=True, slots=True)
class WheelMoment:
    """Where the wheels say that the robot was.

    Attributes
    ----------
    pose
        (3,) in the odom frame.
    guessed_m
        Way until there that no reading tells.
    """

    pose: FloatArray
    guessed_m: float


class WheelTracker:
    """The newest odometry readings, asked for the pose at a scan's stamp."""

    def __init__(self, config: WheelConfig) -> None:
        self._config = config
        self._gaps = WheelGaps()
        # Sums over steps; what they begin with holds the scale at one until some metres are known.
        self._told_m2 = self._true_m2 = 1.0
        self._scale = np.ones(3)
        self._stamp_s = math.nan
        self._pose: FloatArray | None = None
        self._twist: FloatArray | None = None

    def add(self, reading: WheelOdometry) -> FloatArray:
        """Take the next reading in log order: its pose (3,) without jumps that no robot can make."""
        step_s = reading.stamp_s - self._stamp_s
        possible = self.plausible(self._gaps.step(row_from_pose2(reading.T_odom_base)), step_s)
        pose = row_from_pose2(self._gaps.add(reading, possible=possible).T_odom_base)
        self._twist = between(self._pose, pose) / step_s if self._pose is not None and step_s > 0.0 else None
        self._pose = pose
        self._stamp_s = reading.stamp_s
        return pose

    def moment(self, stamp_s: float) -> WheelMoment | None:
        """Where the robot was at a stamp, see `pose_at`; None before any reading."""
        pose = self.pose_at(stamp_s)
        if pose is None:
            return None
        guessed_m, since_s = self._gaps.guessed_m, stamp_s - self._stamp_s
        if self._twist is not None and self._gaps.in_gap(since_s):
            guess = self._twist * since_s
            pose, guessed_m = compose(pose, guess), guessed_m + math.hypot(guess[0], guess[1])
        return WheelMoment(pose, guessed_m)

    def motion(
        self, begun: WheelMoment | None, ended: WheelMoment | None, elapsed_s: float
    ) -> FloatArray | None:
        """Motion (3,) between two moments; None where the wheels do not tell, or no robot can move so."""
        if begun is None or ended is None:
            return None
        step = between(begun.pose, ended.pose) * self._scale
        return step if self.plausible(step, elapsed_s) else None

    def on_top(self, step: FloatArray, begun: WheelMoment, ended: WheelMoment) -> FloatArray:
        """Covariance (3, 3) of a motion (3,) that no experience with the wheels makes smaller.

        The base may sit beside the axle by more than the log tells, so a turn swings it aside. What was
        guessed may be wrong by all of it, and the robot may have turned there.
        """
        guessed_m = abs(ended.guessed_m - begun.guessed_m)
        metres2 = (self._config.swing_m_per_rad * step[2]) ** 2 + guessed_m**2
        return np.diag([metres2, metres2, (_TURN_PER_M * guessed_m) ** 2])

    def learn_scale(self, step: FloatArray, matched: FloatArray) -> None:
        """Learn what a metre of the wheels is from a step (3,) as `motion` told it and as it was matched.

        Least squares over all steps of which both tell much the same.
        """
        told, true = math.hypot(step[0], step[1]), float(np.hypot(matched[0], matched[1]))
        if abs(true - told) > _SCALE_SHARE * told or step[:2] @ matched[:2] <= 0.0:
            return
        told /= self._scale[0]
        self._told_m2 += told * told
        self._true_m2 += told * true
        self._scale[:2] = self._true_m2 / self._told_m2

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

    def covariance(self, step: FloatArray) -> FloatArray:
        """Covariance (3, 3) of a wheel motion ``step`` (3,): floor, and shares of way and turn."""
        config = self._config
        path_m = math.hypot(step[0], step[1])
        turn_rad = abs(float(step[2]))
        sigma_m = config.floor_m + config.distance_share * path_m
        sigma_rad = config.floor_rad + config.turn_share * turn_rad + config.turn_per_m_rad * path_m
        return np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
