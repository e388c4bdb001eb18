"""Interface of every lidar odometry."""

from __future__ import annotations

from typing import Protocol

from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray


class LidarOdometry(Protocol):
    """Scan to local map matching in an odometry frame that drifts slowly and never jumps back."""

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        """Return the pose of the scan's base in the odometry frame, or None if nothing fits.

        Parameters
        ----------
        points
            The scan, base frame.
        guesses
            The most trusted first; at least one.
        alone
            Whether no other sensor measured a guess, so that nothing would contradict a wrong match.
        """
        ...

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        """Return the best pose of the scan close to ``pose`` (3,), however badly it fits."""
        ...

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Return (2, K) evidence of each object in a scan for a pose (3,) against another, in points.

        First from areas known at both poses; second where it fits while the area at the other is unknown.
        """
        ...

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None:
        """Add a scan at a pose (3,) of the odometry frame to the local map."""
        ...
