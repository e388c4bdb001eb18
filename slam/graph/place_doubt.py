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
    """Remembers how unsure the last keyframe's place is; of one that begins a local map, not at all."""

    def __init__(self) -> None:
        self._uncertain: FloatArray | None = None

    def begin(self) -> None:
        """A keyframe begins a local map, and is certain in it."""
        self._uncertain = None

    def add(self, step: gtsam.Pose3, motion: MotionEstimate) -> FloatArray:
        """Covariance (6, 6) of the step to the next keyframe, by its match to the local map."""
        covariance = motion.covariance
        if self._uncertain is not None:
            carried = step.inverse().AdjointMap()
            covariance = covariance + carried @ self._uncertain @ carried.T
        confident = motion.converged and not motion.degenerate
        self._uncertain = None if confident else motion.covariance
        return covariance
