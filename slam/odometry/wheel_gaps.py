"""What wheel odometry cannot mean: jumps between readings, and ways that went on while none came."""

from __future__ import annotations

import math

import numpy as np

from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, pose2_from_row, row_from_pose2

# Beyond this the last reading is too old to be carried on by its own speed.
LONGEST_EXTRAPOLATION_S = 0.5
# Readings this many times as far apart as they use to be are a gap.
_GAP_PERIODS = 5.0
# What is less is no motion: metres and radians, or these a second.
_NO_MOTION = 1e-3
# Readings over which it is learned how far apart they use to be.
_MEMORY = 20.0


class WheelGaps:
    """Joins readings to one motion, and knows how much of it nothing has told.

    A jump that no robot can make is left out: the robot went on as before for this one reading. So it did
    where readings stay away while it moves, and it has not moved by them afterwards; that way is a guess.

    Attributes
    ----------
    guessed_m
        Way so far that is a guess.
    """

    def __init__(self) -> None:
        self._stamp_s = math.nan
        self._told: FloatArray | None = None
        self._pose = np.zeros(3)
        self._twist = np.zeros(3)
        self._period_s = 0.0
        self.guessed_m = 0.0

    def add(self, reading: WheelOdometry, *, possible: bool) -> WheelOdometry:
        """Take the next reading; the same without what came before it that cannot be.

        Parameters
        ----------
        possible
            Whether a robot can have made the motion since the last reading.
        """
        told = row_from_pose2(reading.T_odom_base)
        if self._told is None:
            self._pose = told
        else:
            step_s = reading.stamp_s - self._stamp_s
            step = between(self._told, told)
            if not possible:
                step = self._twist * max(step_s, 0.0)
            elif self.in_gap(step_s) and np.abs(step).max() < _NO_MOTION:
                step = self._twist * step_s
                self.guessed_m += math.hypot(step[0], step[1])
            self._pose = compose(self._pose, step)
            if step_s > 0.0:
                self._twist = step / step_s
                self._period_s += (step_s - self._period_s) / (_MEMORY if self._period_s else 1.0)
        self._told, self._stamp_s = told, reading.stamp_s
        return WheelOdometry(reading.stamp_s, pose2_from_row(self._pose))

    def step(self, told: FloatArray) -> FloatArray:
        """(3,) motion from the last reading to a pose (3,) of the wheels' own frame; zero before any."""
        return np.zeros(3) if self._told is None else between(self._told, told)

    def in_gap(self, since_s: float) -> bool:
        """Whether the last reading is older than readings use to be, and the robot was on its way."""
        moves = bool(np.abs(self._twist).max() > _NO_MOTION)
        return moves and since_s > max(LONGEST_EXTRAPOLATION_S, _GAP_PERIODS * self._period_s)
