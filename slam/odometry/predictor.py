"""Uncertainty of a kind of prediction, learned from the matches."""

from __future__ import annotations

import math

import numpy as np

from slam.matching.motion import Motion
from slam.matching.planar import between
from slam.measurements import FloatArray

# One outlier counts at most as this many times the variance of a predictor.
_GREATEST_SURPRISE = 10.0
# Wheels with small recent errors get a smaller sigma of the path, but not of the rotation, than stated:
# a clock error rotates a robot that moves straight on. The variance is at least this share.
LEAST_SHARE = 0.02


class Predictor:
    """Scale of the uncertainty of a kind of prediction, learned from the matches.

    Parameters
    ----------
    memory_scans
        Number of scans over which errors are averaged.
    least_share
        Smallest factor on the claimed variance of the path; with 1 the variance is never reduced.
    """

    def __init__(self, memory_scans: float, least_share: float = 1.0) -> None:
        self._rate = 1.0 / memory_scans
        self._least_share = least_share
        self._share = 1.0
        self.doubt = 1.0
        self.guesses: list[Motion] = []

    def predict(self, pose: FloatArray, covariance: FloatArray) -> None:
        """Predict a pose (3,) with a claimed covariance (3, 3), rescaled by what was learned so far."""
        self.guesses.append(self.rescaled(pose, covariance))

    def rescaled(self, pose: FloatArray, covariance: FloatArray) -> Motion:
        """Return a pose (3,) with a claimed covariance (3, 3), rescaled by what was learned so far."""
        xy, turn = self.doubt * self._share, self.doubt
        mix = math.sqrt(xy * turn)
        return Motion(pose, covariance * np.array([[xy, xy, mix], [xy, xy, mix], [mix, mix, turn]]))

    def judge(self, pose: FloatArray) -> None:
        """Learn from the pose of the scan (3,): mean normalised squared error of the first guess."""
        if not self.guesses:
            return
        guess = self.guesses[0]
        squares = self.doubt * guess.squared_mahalanobis(pose) / 3.0
        average = self.doubt + self._rate * (min(squares, _GREATEST_SURPRISE * self.doubt) - self.doubt)
        self.doubt = max(1.0, average)
        x, y, _ = between(guess.pose, pose).tolist()
        (xx, xy, _), (_, yy, _), _ = guess.covariance.tolist()
        squares = self._share * (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy) / 2.0
        average = self._share + self._rate * (min(squares, _GREATEST_SURPRISE * self._share) - self._share)
        self._share = min(max(self._least_share, average), 1.0)
