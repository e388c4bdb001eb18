"""Interface of every lidar odometry."""

from __future__ import annotations

from typing import Protocol

from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray


class LidarOdometry(Protocol):
    """Scan to local map matching in an odometry frame that drifts slowly and never jumps back."""

    def match(self, points: ScanPoints, guesses: list[Motion]) -> MotionEstimate | None:
        """Pose of the scan's base in the odometry frame, or None if nothing fits.

        Parameters
        ----------
        points
            The scan, base frame.
        guesses
            The most trusted first; at least one.
        """
        ...

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        """The best pose of the scan that stays close to ``pose`` (3,), however badly it fits."""
        ...

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """What every object in a scan says for a pose (3,) against another one, in points; (2, K).

        By ground that is known at both poses; and where it fits, while nothing is known of the other's.
        """
        ...

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None:
        """Take a scan at a pose (3,) of the odometry frame into the local map."""
        ...
