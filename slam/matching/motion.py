"""A planar motion with its covariance, and a test whether another motion agrees with it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from fusion.estimation import gate
from fusion.kernel import kernel
from slam.matching.planar import compose, wrap
from slam.measurements import FloatArray

# The one gate wherever motions are compared: two that are true agree with this probability (chi-square, three
# degrees of freedom).
_AGREEMENT = 0.97


class Motion(NamedTuple):
    """Where something has moved to, as somebody says.

    Attributes
    ----------
    pose
        (3,) x, y, yaw, seen from where it began.
    covariance
        (3, 3) in the frame of ``pose``.
    """

    pose: FloatArray
    covariance: FloatArray

    def squared_mahalanobis(self, pose: FloatArray) -> float:
        """Squared Mahalanobis distance of a pose (3,)."""
        return float(_squared(self.pose, pose, np.ascontiguousarray(self.covariance)))

    def holds(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) passes the gate, however uncertain it may be itself."""
        return self.squared_mahalanobis(pose) <= gate(3, _AGREEMENT)

    def agrees(self, other: Motion) -> bool:
        """Whether another motion passes the gate, by both their covariances."""
        return self.widened(other.covariance).holds(other.pose)

    def volume(self) -> float:
        """Determinant of the covariance: how uncertain it is in all."""
        (xx, xy, xt), (_, yy, yt), (_, _, tt) = self.covariance.tolist()
        return float(xx * (yy * tt - yt * yt) - xy * (xy * tt - yt * xt) + xt * (xy * yt - yy * xt))

    def looking(self, yaw_rad: float, variance: float) -> Motion:
        """The same, once a heading has been measured too: one step of a Kalman filter."""
        gain = self.covariance[:, 2] / (self.covariance[2, 2] + variance)
        pose = compose(self.pose, gain * wrap(yaw_rad - self.pose[2]))
        return Motion(pose, self.covariance - np.outer(gain, self.covariance[2]))

    def widened(self, covariance: FloatArray) -> Motion:
        """The same, uncertain by another covariance (3, 3) on top."""
        return Motion(self.pose, self.covariance + covariance)


def log_likelihood(predictions: Sequence[Motion], pose: FloatArray) -> float:
    """Of a pose (3,) by all predictions, a heavy tail each: Student's t with three degrees of freedom."""
    return -sum(2.0 * math.log1p(guess.squared_mahalanobis(pose) / 3.0) for guess in predictions)


@kernel(error_model="numpy")
def _squared(begun, ended, covariance):  # type: ignore[no-untyped-def]
    """A step between poses (3,), squared over its covariance (3, 3), by Cholesky; LAPACK takes five times."""
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
