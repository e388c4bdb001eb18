"""Velocity of a 3D lidar, from its last certain matches."""

from __future__ import annotations

import gtsam
import numpy as np

from fusion.estimation import FEWEST
from slam.estimates import MotionEstimate
from slam.matching.cloud_alignment import levers
from slam.measurements import FloatArray

# After this time, the previous velocity no longer predicts the pose.
LONGEST_STEP_S = 1.0


class CloudVelocity:
    """The newest twist (6,) of the base, GTSAM's tangent per second.

    Attributes
    ----------
    twist
        Last measured twist; before that as given, or zero.
    known
        Whether it was measured in this local map, or given.
    rotated
        Whether a gyroscope has compensated the rotation within clouds.
    """

    rotated = False

    def __init__(self, twist: FloatArray | None = None) -> None:
        self.twist: FloatArray = np.zeros(6) if twist is None else twist
        self.known = twist is not None
        # A twist that is given is that of a moment, a measured one the mean of a step.
        self._pose, self._stamp_s, self._step_s = gtsam.Pose3(), -np.inf, 0.0 if self.known else np.inf

    @property
    def speed_m_s(self) -> float:
        """Return the speed from the last certain matches; 0 without any in this local map."""
        return float(np.linalg.norm(self.twist[3:])) if self.known else 0.0

    def begin(self, stamp_s: float) -> None:
        """Start with the first cloud, at the origin."""
        self._stamp_s = stamp_s

    def to(self, pose: gtsam.Pose3, stamp_s: float) -> FloatArray:
        """Return the twist (6,) from the last certain pose to ``T_odom_base``; after a gap, the old one."""
        step_s = stamp_s - self._stamp_s
        if not 0.0 < step_s < LONGEST_STEP_S:
            return self.twist
        return np.asarray(gtsam.Pose3.Logmap(self._pose.between(pose)) / step_s)

    def at(self, pose: gtsam.Pose3, stamp_s: float) -> FloatArray:
        """Return the twist (6,) at the time of a pose, to deskew a cloud.

        It assumes constant acceleration: the mean of a step is the twist half a step ago.
        """
        mean, step_s = self.to(pose, stamp_s), stamp_s - self._stamp_s
        share = step_s / (step_s + self._step_s) if 0.0 < step_s < LONGEST_STEP_S else 0.0
        twist = np.asarray(mean + share * (mean - self.twist))
        return np.append(np.zeros(3), twist[3:]) if self.rotated else twist

    def misplaced(self, pose: gtsam.Pose3, stamp_s: float, times_s: FloatArray) -> FloatArray:
        """Return (6,) how far a match at ``T_odom_base`` is off by a constant twist that has changed.

        It is the mean of half the acceleration times the square of the times (N,) around the stamp.
        """
        offset = self.at(pose, stamp_s) - self.twist * ([not self.rotated] * 3 + [True] * 3)
        passed_s = stamp_s - self._stamp_s + 0.5 * self._step_s
        return np.asarray(0.5 * offset / passed_s * np.mean(times_s**2)) if passed_s > 0.0 else np.zeros(6)

    def carry_on(self, twist: FloatArray, stamp_s: float) -> gtsam.Pose3 | None:
        """Extrapolate the last certain pose with a twist (6,); None after a gap."""
        step_s = stamp_s - self._stamp_s
        if not 0.0 < step_s < LONGEST_STEP_S:
            return None
        return self._pose.compose(gtsam.Pose3.Expmap(twist * step_s))

    def learn(self, pose: gtsam.Pose3, stamp_s: float, arms_m: FloatArray, motion: MotionEstimate) -> None:
        """Learn from a certain match.

        Along an undetermined direction, the twist changes slowly, or noise would be extrapolated.

        Parameters
        ----------
        arms_m
            (3, 3) of the points, see `slam.matching.cloud_alignment.arms_of`.
        """
        step_s = stamp_s - self._stamp_s
        if -LONGEST_STEP_S < step_s <= 0.0:
            # A repeated or late stamp, or a clock set back, gives no speed; the next step starts there.
            self._pose, self._stamp_s = pose, stamp_s
            return
        twist = self.to(pose, stamp_s)
        if motion.degenerate:
            lever = levers(arms_m)
            weak = lever @ motion.weak_direction
            weak /= np.linalg.norm(weak)
            kept = (1.0 - 1.0 / FEWEST) * (weak @ lever @ (twist - self.twist))
            twist = twist - np.linalg.solve(lever, weak) * kept
        self.known = self.known or step_s < LONGEST_STEP_S
        self._step_s = step_s if step_s < LONGEST_STEP_S else np.inf
        self._pose, self._stamp_s, self.twist = pose, stamp_s, twist
