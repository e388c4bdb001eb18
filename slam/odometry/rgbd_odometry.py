"""Interface of every RGB-D odometry."""

from __future__ import annotations

from typing import Protocol

import gtsam

from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch


class RgbdOdometry(Protocol):
    """Matching of a frame to keyframes whose poses are known."""

    def match(
        self, frame: PreparedFrame, local: list[VisualKeyframe], guess: gtsam.Pose3
    ) -> VisualMatch | None:
        """Return the pose of the frame's camera, or None if nothing fits.

        Parameters
        ----------
        local
            Keyframes that may see the same, the most similar first; at least one.
        guess
            Expected ``T_odom_camera``.
        """
        ...
