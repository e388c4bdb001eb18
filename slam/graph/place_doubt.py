"""Steps between keyframes that were matched to a local map, where one was not surely placed in it.

A match tells where a keyframe is among those of the local map. The one before it may have been put there by a
guess, wholly or in a direction that nothing determined; then the step between the two is no more certain than
the guess. Nor is the way from those before it: what stands in a wrong place is in the local map, too.
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
