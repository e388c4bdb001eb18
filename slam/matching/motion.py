"""A planar motion with its covariance, and a test whether another motion agrees with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion.estimation import gate
from fusion.kernel import kernel
from slam.matching.planar import adjoint, between, compose, rotate_covariance, wrap
from slam.measurements import FloatArray

# The gate for all comparisons of motions: two correct ones agree with this probability (chi-square, three
# degrees of freedom).
_AGREEMENT = 0.97


class Motion(NamedTuple):
    """A measured or predicted planar motion.

    Attributes
    ----------
    pose
        (3,) x, y, yaw, in the frame of its start.
    covariance
        (3, 3) in the frame of ``pose``.
    """

    pose: FloatArray
    covariance: FloatArray

    def squared_mahalanobis(self, pose: FloatArray) -> float:
        """Return the squared Mahalanobis distance of a pose (3,)."""
        return float(_squared(self.pose, pose, np.ascontiguousarray(self.covariance)))

    def holds(self, pose: FloatArray) -> bool:
        """Return whether a pose (3,) passes the gate, without its own uncertainty."""
        return self.squared_mahalanobis(pose) <= gate(3, _AGREEMENT)

    def agrees(self, other: Motion) -> bool:
        """Return whether another motion passes the gate, by both their covariances."""
        return self.widened(other.covariance).holds(other.pose)

    def volume(self) -> float:
        """Return the determinant of the covariance, its total uncertainty."""
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = self.covariance.tolist()
        return float(xx * (yy * tt - yt * yt) - xy * (xy * tt - yt * xt) + xt * (xy * yt - yy * xt))

    def looking(self, yaw_rad: float, variance: float) -> Motion:
        """Return the motion fused with a measured heading: one step of a Kalman filter."""
        gain = self.covariance[:, 2] / (self.covariance[2, 2] + variance)
        pose = compose(self.pose, gain * wrap(yaw_rad - self.pose[2]))
        return Motion(pose, self.covariance - np.outer(gain, self.covariance[2]))

    def inverse(self) -> Motion:
        """Return the motion from its end to its start."""
        back = between(self.pose, np.zeros(3))
        return Motion(back, rotate_covariance(adjoint(self.pose), self.covariance))

    def widened(self, covariance: FloatArray) -> Motion:
        """Return the motion with another covariance (3, 3) added."""
        return Motion(self.pose, self.covariance + covariance)


def log_likelihood(predictions: Sequence[Motion], pose: FloatArray) -> float:
    """Return that of a pose (3,) by all predictions (Student's t with three degrees of freedom)."""
    return -sum(2.0 * math.log1p(guess.squared_mahalanobis(pose) / 3.0) for guess in predictions)


@kernel(error_model="numpy")
def _squared(begun, ended, covariance):  # type: ignore[no-untyped-def]
    """Return the squared Mahalanobis norm of a step (3,) by Cholesky; LAPACK takes five times as long."""
    d0 = covariance[0, 0]
    l10 = covariance[1, 0] / d0
    l20 = covariance[2, 0] / d0
    d1 = covariance[1, 1] - l10 * covariance[1, 0]
    l21 = (covariance[2, 1] - l20 * covariance[1, 0]) / d1
    d2 = covariance[2, 2] - l20 * covariance[2, 0] - l21 * l21 * d1
    cos, sin = math.cos(begun[2]), math.sin(begun[2])
    dx, dy, turn = ended[0] - begun[0], ended[1] - begun[1], ended[2] - begun[2]
    x = cos * dx + sin * dy
    y = cos * dy - sin * dx - l10 * x
    turn -= 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
    turn -= l20 * x + l21 * y
    return x * x / d0 + y * y / d1 + turn * turn / d2
