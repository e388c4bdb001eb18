"""A motion in the plane with its covariance, and the one question asked of it: does another agree?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion.estimation import gate
from slam.matching.planar import between
from slam.measurements import FloatArray

# The one gate wherever motions are compared: two that are true agree with this probability (chi-square, three
# degrees of freedom).
_AGREEMENT = 0.97


@dataclass(frozen=True, slots=True)
class Motion:
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
        innovation = between(self.pose, pose)
        return float(innovation @ np.linalg.solve(self.covariance, innovation))

    def holds(self, pose: FloatArray) -> bool:
        """Whether a pose (3,) passes the gate, however uncertain it may be itself."""
        return self.squared_mahalanobis(pose) <= gate(3, _AGREEMENT)

    def agrees(self, other: Motion) -> bool:
        """Whether another motion passes the gate, by both their covariances."""
        return self.widened(other.covariance).holds(other.pose)

    def widened(self, covariance: FloatArray) -> Motion:
        """The same, uncertain by another covariance (3, 3) on top."""
        return Motion(self.pose, self.covariance + covariance)
