"""Steps between keyframes that were matched to a local map, where one was not surely placed in it.

A match tells where a keyframe is among those of the local map. The one before it may have been put there by a
guess, wholly or in a direction that nothing determined; then the step between the two is no more certain than
the guess, and what is certain is the way from the last keyframe that was surely placed.
"""

from __future__ import annotations

import gtsam

from slam.estimates import MotionEstimate
from slam.graph.edge import Edge, EdgeKind
from slam.measurements import FloatArray


class AnchoredSteps:
    """Remembers the last keyframe that was surely placed.

    Parameters
    ----------
    reach
        Keyframes that make the local map: an older one is not in it.
    """

    def __init__(self, reach: int) -> None:
        self._reach = reach
        self._confident = 0, gtsam.Pose3()
        self._uncertain: FloatArray | None = None

    def begin(self, key: int, pose: gtsam.Pose3) -> None:
        """A keyframe at ``T_odom_base`` that begins a local map, and is certain in it."""
        self._confident, self._uncertain = (key, pose), None

    def add(
        self, key: int, step: gtsam.Pose3, pose: gtsam.Pose3, motion: MotionEstimate
    ) -> tuple[FloatArray, Edge | None]:
        """Take the next keyframe.

        Parameters
        ----------
        step
            Motion from the last keyframe.
        pose
            ``T_odom_base``.
        motion
            Its match to the local map.

        Returns
        -------
        Covariance (6, 6) of the step; and an edge past the last keyframe where only that was uncertain.
        """
        covariance, bridge = motion.covariance, None
        confident = motion.converged and not motion.degenerate
        anchor, T_odom_anchor = self._confident
        if self._uncertain is not None:
            carried = step.inverse().AdjointMap()
            covariance = covariance + carried @ self._uncertain @ carried.T
            if confident and key - anchor <= self._reach:
                # The uncertain keyframes between are in the local map, too.
                between = T_odom_anchor.between(pose)
                spread = (key - anchor) ** 2 * motion.covariance
                bridge = Edge(anchor, key, between, spread, EdgeKind.LIDAR, trusted=True)
        if confident:
            self._confident, self._uncertain = (key, pose), None
        else:
            self._uncertain = motion.covariance
        return covariance, bridge
