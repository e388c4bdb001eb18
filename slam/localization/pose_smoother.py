"""The newest poses as a fixed-lag factor graph: odometry between them, the map's word on each."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.measurements import FloatArray, pose2_from_row, row_from_pose2


class PoseSmoother:
    """Planar poses one after the other; what is older than the lag is marginalised.

    Parameters
    ----------
    pose, covariance
        (3,) in the map and (3, 3) in the base frame, of the first.
    lag_nodes
        Poses that may still change.
    """

    def __init__(self, pose: FloatArray, covariance: FloatArray, lag_nodes: int) -> None:
        # Time counts nodes: stamps of a log may run backward.
        self._smoother = gtsam.IncrementalFixedLagSmoother(float(lag_nodes), gtsam.ISAM2Params())
        self._newest = 0
        first = pose2_from_row(pose)
        prior = gtsam.PriorFactorPose2(0, first, gtsam.noiseModel.Gaussian.Covariance(covariance))
        self._update([prior], first)

    def predict(self, step: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pose (3,) and covariance (3, 3) after a step (3,) with its covariance, not yet taken."""
        motion = pose2_from_row(step)
        pose = row_from_pose2(pose2_from_row(self.pose).compose(motion))
        adjoint = motion.inverse().AdjointMap()
        return pose, adjoint @ self.covariance @ adjoint.T + covariance

    def add(
        self, step: FloatArray, covariance: FloatArray, seen: list[tuple[FloatArray, FloatArray]]
    ) -> None:
        """Take a step (3,) with its covariance, and what was measured of the pose after it.

        Parameters
        ----------
        seen
            Poses (3,) in the map with their covariances (3, 3), base frame.
        """
        key = self._newest + 1
        noise = gtsam.noiseModel.Gaussian.Covariance
        motion = pose2_from_row(step)
        factors: list[gtsam.NonlinearFactor] = [
            gtsam.BetweenFactorPose2(self._newest, key, motion, noise(covariance))
        ]
        factors += [gtsam.PriorFactorPose2(key, pose2_from_row(pose), noise(c)) for pose, c in seen]
        self._newest = key
        self._update(factors, pose2_from_row(self.pose).compose(motion))

    def _update(self, factors: list[gtsam.NonlinearFactor], guess: gtsam.Pose2) -> None:
        """Add a node and solve."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in factors:
            graph.add(factor)
        values.insert(self._newest, guess)
        self._smoother.update(graph, values, {self._newest: float(self._newest)})
        self.pose: FloatArray = row_from_pose2(self._smoother.calculateEstimatePose2(self._newest))
        self.covariance: FloatArray = np.array(self._smoother.marginalCovariance(self._newest))
