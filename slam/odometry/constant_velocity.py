"""Constant velocity prediction: the last motion, scaled to another time, if nothing else measures it."""

from __future__ import annotations

import math

import numpy as np

from fusion.time_alignment import GAP_S
from slam.config.stages import PredictionConfig
from slam.matching.match_covariance import OPEN_M
from slam.matching.motion import Motion
from slam.measurements import FloatArray

# A velocity is extrapolated over at most this many times the step of its measurement.
_GREATEST_STRETCH = 3.0


class Velocity:
    """Velocity of a robot from its last steps.

    Attributes
    ----------
    step, step_s
        (3,) the motion x, y, yaw of the base in so many seconds.
    """

    def __init__(self) -> None:
        self.step, self.step_s = np.zeros(3), 0.0
        # Mean of the outer products of all velocities, (2, 2), from so many, and how many since it stood.
        self._usual, self._count, self._since = np.eye(2), 1, 0

    def learn(self, step: FloatArray, step_s: float) -> None:
        """Take the velocity of a step (3,)."""
        self.step, self.step_s = step, step_s

    def follow(self, step: FloatArray, step_s: float, weak: FloatArray) -> None:
        """Average the velocity over half a second, with a step (3,) that leaves no or a direction (3,) open.

        One step alone is as noisy as its two matches, and is continued for as long as a direction is open. A
        Kalman filter whose velocity changes as the robot usually moves: one that only moves ahead and has
        turned across a corridor stands still, if the corridor shows that it does not move across.
        """
        self._since += 1
        rate = max(min(abs(step_s) / GAP_S, 1.0), 1.0 / self._since)
        before = self.step[:2] * (step_s / self.step_s if self.step_s else 0.0)
        changes = self._usual * step_s**2
        gain = rate * changes @ np.linalg.inv(changes + rate * OPEN_M**2 * np.outer(weak, weak)[:2, :2])
        moved = before + gain @ (step[:2] - before)
        self.step, self.step_s = np.array([*moved, step[2]]), step_s
        if not weak.any():
            self._count += 1
            self._usual += (np.outer(moved, moved) / step_s**2 - self._usual) / self._count

    def stop(self) -> None:
        """Take the robot to stand still."""
        self.step, self._since = np.zeros(3), 0


def stretch(step_s: float, measured_s: float) -> float:
    """Return how often a step of ``measured_s`` is repeated in ``step_s``; once if no time passed."""
    if step_s <= 0.0 or measured_s <= 0.0:
        return 1.0
    return min(step_s / measured_s, _GREATEST_STRETCH)


def repeated(
    step: FloatArray,
    measured_s: float,
    step_s: float,
    config: PredictionConfig,
    *,
    alone: bool = False,
    steady_s: float = GAP_S,
) -> Motion:
    """Scale a motion (3,) measured over one time to another time.

    The acceleration is unknown, so the error grows with the square of the time beyond ``steady_s``. If it is
    the only prediction, ``alone``, it ends with a gap: by then, the rotation has changed.
    """
    ends_s = max(GAP_S, measured_s) if alone else step_s
    step = step * stretch(min(step_s, ends_s), measured_s)
    sigma_m = config.velocity_floor + config.velocity_share * math.hypot(step[0], step[1])
    sigma_rad = config.velocity_floor + config.velocity_share * abs(float(step[2]))
    covariance = np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])
    return Motion(step, covariance * max(step_s / steady_s, 1.0) ** 4)
