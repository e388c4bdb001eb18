"""Covariance of steps whose match depends on a keyframe in the local map with an uncertain pose.

A match gives the pose of a keyframe relative to those of the local map. The keyframe before it may have been
placed there by a guess, completely or in a degenerate direction; then the step between the two is only as
certain as the guess. So is the path from earlier keyframes: a wrongly placed one is in the local map, too.
"""

from __future__ import annotations

import gtsam

from slam.estimates import MotionEstimate
from slam.measurements import FloatArray


class PlaceDoubt:
    """Stores the uncertainty of the last keyframe in the local map; zero for the first one in it."""

    def __init__(self) -> None:
        self._uncertain: FloatArray | None = None

    def begin(self) -> None:
        """Start a local map with a keyframe, which is certain in it."""
        self._uncertain = None

    def add(self, step: gtsam.Pose3, motion: MotionEstimate) -> FloatArray:
        """Return (6, 6) the covariance of the step to the next keyframe, from its match to the local map."""
        covariance = motion.covariance
        if self._uncertain is not None:
            carried = step.inverse().AdjointMap()
            covariance = covariance + carried @ self._uncertain @ carried.T
        confident = motion.converged and not motion.degenerate
        self._uncertain = None if confident else motion.covariance
        return covariance
