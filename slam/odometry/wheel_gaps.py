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
    """Joins readings to one motion, and knows across which of them nothing is told.

    A jump that no robot can make is left out: the robot went on as before for this one reading. Where
    readings stay away while the robot moves, and it has not moved by them afterwards, the way between is not
    known.
    """

    def __init__(self) -> None:
        self._stamp_s = math.nan
        self._told: FloatArray | None = None
        self._pose = np.zeros(3)
        self._twist = np.zeros(3)
        self._period_s = 0.0
        self._stretch = 0

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
            elif self._is_gap(step_s) and self._moves() and np.abs(step).max() < _NO_MOTION:
                self._stretch += 1
            self._pose = compose(self._pose, step)
            if step_s > 0.0:
                self._twist = step / step_s
                self._period_s += (step_s - self._period_s) / (_MEMORY if self._period_s else 1.0)
        self._told, self._stamp_s = told, reading.stamp_s
        return WheelOdometry(reading.stamp_s, pose2_from_row(self._pose))

    def stretch_at(self, stamp_s: float) -> int | None:
        """Number of the stretch without a gap that a stamp lies in; None in a gap while the robot moves."""
        return None if self._is_gap(stamp_s - self._stamp_s) and self._moves() else self._stretch

    def step(self, told: FloatArray) -> FloatArray:
        """(3,) motion from the last reading to a pose (3,) of the wheels' own frame; zero before any."""
        return np.zeros(3) if self._told is None else between(self._told, told)

    def _is_gap(self, step_s: float) -> bool:
        """Whether readings use to come much faster than this."""
        return step_s > max(LONGEST_EXTRAPOLATION_S, _GAP_PERIODS * self._period_s)

    def _moves(self) -> bool:
        """Whether the robot was on its way at the last reading."""
        return bool(np.abs(self._twist).max() > _NO_MOTION)
