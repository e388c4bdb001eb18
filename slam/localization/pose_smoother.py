"""Fixed-lag factor graph of the newest poses: odometry between them, and matches to the map."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import SupportsFloat, SupportsIndex, SupportsInt

import gtsam
import numpy as np

from slam.localization.poses import SAME_M, Measured, position_sigma_m
from slam.measurements import Pose, composed

# Only the newest pose is reported, and a longer lag gives the same bits.
_LAG_NODES = 2.0


class PoseSmoother:
    """Consecutive poses, all Pose2 or all Pose3; poses older than the lag are marginalised.

    Parameters
    ----------
    first
        First pose in the map, covariance in the base frame.
    """

    def __init__(self, first: Measured) -> None:
        # Time counts nodes: stamps of a log may run backward.
        self._smoother = gtsam.IncrementalFixedLagSmoother(_LAG_NODES, gtsam.ISAM2Params())
        self._newest = 0
        self._planar = isinstance(first.pose, gtsam.Pose2)
        self.newest = self._update([self._seen(first)], first.pose)

    @property
    def sigma_m(self) -> float:
        """Largest standard deviation of the newest position."""
        return position_sigma_m(self.newest)

    @property
    def trust(self) -> float:
        """Return the probability that the newest position is right, by its standard deviation (Rayleigh)."""
        return 1.0 - math.exp(-0.5 * (SAME_M / self.sigma_m) ** 2)

    def add(self, step: Measured, measured: Sequence[Measured]) -> None:
        """Add a step, and the measured pose in the map after it."""
        before, self._newest = self._newest, self._newest + 1
        factors = [_between(before, self._newest, step), *(self._seen(pose) for pose in measured)]
        self.newest = self._update(factors, composed(self.newest.pose, step.pose))

    def add_seen(self, measured: Measured) -> None:
        """Add a measurement of the newest pose."""
        self.newest = self._update([self._seen(measured)], None)

    def _seen(self, measured: Measured) -> gtsam.NonlinearFactor:
        """Return a factor on the newest pose."""
        if isinstance(measured.pose, gtsam.Pose2):
            return gtsam.PriorFactorPose2(self._newest, measured.pose, _noise(measured))
        return gtsam.PriorFactorPose3(self._newest, measured.pose, _noise(measured))

    def _update(self, factors: Sequence[gtsam.NonlinearFactor], guess: Pose | None) -> Measured:
        """Add factors, and a node if its guess is given; return the newest pose from all factors."""
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for factor in factors:
            graph.add(factor)
        stamps: dict[SupportsInt | SupportsIndex, SupportsFloat | SupportsIndex] = {}
        if guess is not None:
            values.insert(self._newest, guess)
            stamps[self._newest] = float(self._newest)
        self._smoother.update(graph, values, stamps)
        estimate = (
            self._smoother.calculateEstimatePose2 if self._planar else self._smoother.calculateEstimatePose3
        )
        return Measured(estimate(self._newest), np.array(self._smoother.marginalCovariance(self._newest)))


def _between(before: int, after: int, step: Measured) -> gtsam.NonlinearFactor:
    """Return a factor between two poses."""
    if isinstance(step.pose, gtsam.Pose2):
        return gtsam.BetweenFactorPose2(before, after, step.pose, _noise(step))
    return gtsam.BetweenFactorPose3(before, after, step.pose, _noise(step))


def _noise(measured: Measured) -> gtsam.noiseModel.Base:
    """Return the noise model of a measurement."""
    return gtsam.noiseModel.Gaussian.Covariance(measured.covariance)
