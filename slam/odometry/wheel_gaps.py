"""Errors in wheel odometry: jumps between readings, and motion during which it counted nothing."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import FEWEST, SETTLED, TINY
from fusion.time_alignment import GAP_S
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry, row_from_pose2

# No wheel grips a floor so well that it brakes harder, m/s^2: friction of one half.
_HARDEST_BRAKING = 4.9


class WheelGaps:
    """Joins readings to one motion, and knows how much of it nothing has told.

    A jump that the robot does not make is left out: it went on as before for this one reading. If the next
    is as fast, the robot is, or has jumped back: then it is put back. Where readings stay away or repeat each
    other for a while after a speed from which no robot stops at once it went on, and that way is a guess. If
    they go on repeating each other it stands, as uncertain as if it had gone on.

    Attributes
    ----------
    guessed_m
        Way so far that is a guess.
    period_s
        Time between two readings as a rule.
    """

    def __init__(self) -> None:
        self._told: FloatArray | None = None
        self._pose = self._counted = np.zeros(3)
        # Of the last reading, of the last one that moved, and until when the way is in the pose.
        self._stamp_s = self._counted_s = self._placed_s = math.nan
        self._twist = np.zeros(3)
        # What was left out of the last reading; None if that was as fast as usual.
        self._left_out: FloatArray | None = None
        self.period_s = self._lasted_s = 0.0
        # The time in which a robot stops, and the longest between two readings since the last that moved.
        self._stop_s = self._silent_s = 0.0
        # Whether readings have repeated each other for so long that the robot stands.
        self._stands = False
        self.guessed_m = 0.0

    def add(self, reading: WheelOdometry, step: FloatArray, step_s: float, *, usual: bool) -> FloatArray:
        """Take the next reading: its pose (3,) without what came before it that cannot be.

        Parameters
        ----------
        step, step_s
            As `step` tells them of the reading.
        usual
            Whether the robot makes such motions.
        """
        guess, guess_m = self.guess_at(reading.stamp_s)
        self._stands = guess_m > 0.0 and not guess.any()
        stamp_s, self._stamp_s = reading.stamp_s, reading.stamp_s
        told, self._told = self._told, row_from_pose2(reading.T_odom_base)
        if told is None:
            self._pose = self._counted = self._told
            self._counted_s = self._placed_s = stamp_s
            return self._pose
        if step_s > 0.0:
            self.period_s += (min(step_s, GAP_S) - self.period_s) / (FEWEST if self.period_s else 1.0)
        x, y, turn = step.tolist()
        lone = not usual and self._left_out is None
        # A reading that repeats the last one, as scan lines do, tells nothing of how fast the robot is.
        left_out = (None if usual else np.zeros(3)) if np.count_nonzero(step) else self._left_out
        # Whoever cannot have stopped has not turned on the spot either: then the heading has jumped.
        still = not lone and max(abs(x), abs(y)) < SETTLED and (abs(turn) < SETTLED or guess_m > 0.0)
        if lone:
            onward = self._twist * max(step_s, 0.0)
            step, left_out = onward, between(onward, step)
        elif still:
            step = guess
            self.guessed_m += guess_m
            # It can have stopped in a silence: readings that repeat as often as ever after one are true.
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
        """Motion (3,) since the last reading and its time; zero and not a number before any."""
        if self._told is None:
            return np.zeros(3), math.nan
        return between(self._told, row_from_pose2(reading.T_odom_base)), reading.stamp_s - self._stamp_s

    def guess_at(self, stamp_s: float) -> tuple[FloatArray, float]:
        """(3,) motion since the last reading that the wheels have not counted, and how far that may be off.

        Zero where there is none.
        """
        since_s, uncounted_s = stamp_s - self._placed_s, stamp_s - self._counted_s
        if not self._stop_s > self._lasted_s < 0.5 * uncounted_s or since_s <= 0.0:
            return np.zeros(3), 0.0
        repeated = uncounted_s > 0.5 * FEWEST * GAP_S and stamp_s - self._stamp_s < GAP_S
        guess = np.zeros(3) if repeated or self._stands else self._twist * since_s
        return guess, math.hypot(self._twist[0], self._twist[1]) * since_s

    def _count(self, stamp_s: float) -> None:
        """Take the speed since the last reading that moved; of two close together, the stamps tell none."""
        since_s = stamp_s - self._counted_s
        if since_s >= max(self.period_s, TINY):
            self._twist, self._lasted_s = between(self._counted, self._pose) / since_s, since_s
            # Who stands still at the end of that time was twice as fast at its beginning.
            self._stop_s = 2.0 * math.hypot(self._twist[0], self._twist[1]) / _HARDEST_BRAKING
        if since_s >= self.period_s or since_s < 0.0:
            self._counted, self._counted_s = self._pose, stamp_s
