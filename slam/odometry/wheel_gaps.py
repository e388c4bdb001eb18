"""What wheel odometry cannot mean: jumps between readings, and ways that went on while none came."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import FEWEST, SETTLED
from fusion.time_alignment import GAP_S
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2

# Readings this many times as far apart as they use to be are a gap.
_GAP_PERIODS = 5.0


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

    def add(self, reading: WheelOdometry, *, possible: bool) -> FloatArray:
        """Take the next reading: its pose (3,) without what came before it that cannot be.

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
            elif self._in_gap(step_s) and np.abs(step).max() < SETTLED:
                step = self._twist * step_s
                self.guessed_m += math.hypot(step[0], step[1])
            self._pose = compose(self._pose, step)
            if step_s > 0.0:
                self._twist = step / step_s
                self._period_s += (step_s - self._period_s) / (FEWEST if self._period_s else 1.0)
        self._told, self._stamp_s = told, reading.stamp_s
        return self._pose

    def step(self, reading: WheelOdometry) -> tuple[FloatArray, float]:
        """Motion (3,) since the last reading and its time; zero and not a number before any."""
        if self._told is None:
            return np.zeros(3), math.nan
        return between(self._told, row_from_pose2(reading.T_odom_base)), reading.stamp_s - self._stamp_s

    def guess_at(self, stamp_s: float) -> FloatArray:
        """(3,) motion since the last reading that a gap hides; zero where there is none."""
        since_s = stamp_s - self._stamp_s
        return self._twist * since_s if self._in_gap(since_s) else np.zeros(3)

    def _in_gap(self, since_s: float) -> bool:
        """Whether the last reading is older than readings use to be, and the robot was on its way."""
        moves = bool(np.abs(self._twist).max() > SETTLED)
        return moves and since_s > max(GAP_S, _GAP_PERIODS * self._period_s)
