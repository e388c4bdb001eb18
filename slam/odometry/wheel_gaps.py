"""Errors in wheel odometry: jumps between readings, and motion during which it counted nothing."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import FEWEST, SETTLED, TINY
from fusion.time_alignment import GAP_S
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2

# Largest deceleration of a wheel, m/s^2: friction coefficient one half.
_HARDEST_BRAKING = 4.9


class WheelGaps:
    """Joins readings to one path, and tracks how much of it was not measured.

    An impossible jump is removed: for this reading, the robot is assumed to continue as before. If the next
    one is as fast, the robot is fast or has jumped back: then it is restored. If readings are missing or
    repeated for a while after a speed from which no robot stops at once, it moved on, and that path is a
    guess. If they continue to repeat, it stands still, as uncertain as if it had moved on.

    Attributes
    ----------
    guessed_m
        Path length so far that is a guess.
    period_s
        Usual time between two readings.
    """

    def __init__(self) -> None:
        self._reported: FloatArray | None = None
        self._pose = self._counted = np.zeros(3)
        # Stamps of the last reading, of the last moving one, and up to which the path is in the pose.
        self._stamp_s = self._counted_s = self._placed_s = math.nan
        self._twist = np.zeros(3)
        # Motion removed from the last reading; None if its speed was usual.
        self._left_out: FloatArray | None = None
        self.period_s = self._lasted_s = 0.0
        # Stopping time of a robot, and the longest time between two readings since the last moving one.
        self._stop_s = self._silent_s = 0.0
        # Whether readings have repeated for so long that the robot stands still.
        self._has_stopped = False
        self.guessed_m = 0.0

    def add(self, reading: WheelOdometry, step: FloatArray, step_s: float, *, usual: bool) -> FloatArray:
        """Add the next reading; return its pose (3,) without previous impossible jumps.

        Parameters
        ----------
        step, step_s
            Results of `step` for the reading.
        usual
            Whether such a motion is usual for the robot.
        """
        guess, guess_m = self.guess_at(reading.stamp_s)
        self._has_stopped = guess_m > 0.0 and not guess.any()
        stamp_s, self._stamp_s = reading.stamp_s, reading.stamp_s
        previous, self._reported = self._reported, row_from_pose2(reading.T_odom_base)
        if previous is None:
            self._pose = self._counted = self._reported
            self._counted_s = self._placed_s = stamp_s
            return self._pose
        if step_s > 0.0:
            self.period_s += (min(step_s, GAP_S) - self.period_s) / (FEWEST if self.period_s else 1.0)
        x, y, turn = step.tolist()
        lone = not usual and self._left_out is None
        # A reading that repeats the last one, as scan lines do, gives no speed.
        left_out = (None if usual else np.zeros(3)) if np.count_nonzero(step) else self._left_out
        # A robot that cannot have stopped has not rotated on the spot either: the heading has jumped.
        still = not lone and max(abs(x), abs(y)) < SETTLED and (abs(turn) < SETTLED or guess_m > 0.0)
        if lone:
            onward = self._twist * max(step_s, 0.0)
            step, left_out = onward, between(onward, step)
        elif still:
            step = guess
            self.guessed_m += guess_m
            # It can have stopped during a silence: then repeated readings at the usual rate are correct.
            if step_s <= self.period_s and self._silent_s > self._stop_s:
                self._stop_s = 0.0
            self._silent_s = max(self._silent_s, step_s)
        elif self._left_out is not None and not usual:
            begun = compose(self._pose, self._left_out)
            self._counted, self._pose = compose(begun, between(self._pose, self._counted)), begun
        self._left_out = left_out
        self._pose = compose(self._pose, step)
        if not still or guess_m > 0.0:
            self._placed_s = stamp_s
        if not still:
            self._silent_s = 0.0
            self._count(stamp_s)
        return self._pose

    def step(self, reading: WheelOdometry) -> tuple[FloatArray, float]:
        """Return the motion (3,) since the last reading and its time; zero and NaN before any."""
        if self._reported is None:
            return np.zeros(3), math.nan
        return between(self._reported, row_from_pose2(reading.T_odom_base)), reading.stamp_s - self._stamp_s

    def guess_at(self, stamp_s: float) -> tuple[FloatArray, float]:
        """Return (3,) the uncounted motion since the last reading, and its possible error.

        Zero where there is none.
        """
        since_s, uncounted_s = stamp_s - self._placed_s, stamp_s - self._counted_s
        if not self._stop_s > self._lasted_s < 0.5 * uncounted_s or since_s <= 0.0:
            return np.zeros(3), 0.0
        repeated = uncounted_s > 0.5 * FEWEST * GAP_S and stamp_s - self._stamp_s < GAP_S
        guess = np.zeros(3) if repeated or self._has_stopped else self._twist * since_s
        return guess, math.hypot(self._twist[0], self._twist[1]) * since_s

    def _count(self, stamp_s: float) -> None:
        """Learn the speed since the last moving reading; two close stamps give none."""
        since_s = stamp_s - self._counted_s
        if since_s >= max(self.period_s, TINY):
            self._twist, self._lasted_s = between(self._counted, self._pose) / since_s, since_s
            # If it stands still at the end of that time, it was twice as fast at its start.
            self._stop_s = 2.0 * math.hypot(self._twist[0], self._twist[1]) / _HARDEST_BRAKING
        if since_s >= self.period_s or since_s < 0.0:
            self._counted, self._counted_s = self._pose, stamp_s
