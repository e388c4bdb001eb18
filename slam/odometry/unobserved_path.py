"""Uncertainty of a path along which clouds determine nothing: a tunnel, a long wall, an open field."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from slam.estimates import MotionEstimate
from slam.measurements import FloatArray


class UnobservedPath:
    """Time since all directions were last determined, and covariance added to keyframes since then.

    Parameters
    ----------
    greatest_speed_m_s
        Largest speed of a robot whose motion was not measured.
    """

    def __init__(self, greatest_speed_m_s: float) -> None:
        self._greatest_m_s = greatest_speed_m_s
        self._known_s: float | None = None
        self._speed_m_s = 0.0
        self._variance_m2 = self._added_m2 = 0.0
        self._direction = np.zeros(6)

    def add_keyframe(self) -> None:
        """Restart at a keyframe: the uncertainty so far is in the edges."""
        self._added_m2 = self._variance_m2

    def widened(self, stamp_s: float, motion: MotionEstimate, twist: FloatArray) -> MotionEstimate:
        """Return a match with the uncertainty of the path since the last keyframe in undetermined directions.

        The robot may have stopped, or moved twice as fast: the distance is uniform from zero to twice the
        guess, with sigma guess / sqrt(3). Errors of consecutive guesses are correlated, so sigma grows with
        time, not with its square root.

        Parameters
        ----------
        twist
            (6,) last determined twist of the base.
        """
        if motion.converged and not motion.degenerate:
            self._known_s, self._variance_m2 = stamp_s, 0.0
            self._added_m2, self._direction = 0.0, np.zeros(6)
            self._speed_m_s = float(np.linalg.norm(twist[3:]))
            return motion
        if motion.degenerate and (ahead := float(np.linalg.norm(motion.weak_direction[3:]))) > 0.5:
            self._direction = motion.weak_direction / ahead
        if not self._direction.any():
            return motion
        if self._known_s is None:
            self._known_s, variance = stamp_s, 0.0
        else:
            speed = max(self._speed_m_s, self._greatest_m_s)
            variance = (speed * (stamp_s - self._known_s)) ** 2 / 3.0
        self._variance_m2 = max(variance, self._variance_m2)
        more = math.sqrt(max(self._variance_m2 - self._added_m2, 0.0)) * self._direction
        return replace(motion, covariance=motion.covariance + np.outer(more, more))
