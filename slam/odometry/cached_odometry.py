"""Lidar odometry whose results may come from an interrupted run."""

from __future__ import annotations

from slam.estimates import MotionEstimate
from slam.matching.motion import Motion
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray
from slam.odometry.lidar_odometry import LidarOdometry
from slam.result_cache import ResultCache

# Names of its queries.
MATCH, NEAR, EVIDENCE = "scan", "held scan", "evidence"


class CachedOdometry:
    """See `slam.odometry.lidar_odometry.LidarOdometry`; keyframes are always added to the odometry."""

    def __init__(self, odometry: LidarOdometry, result_cache: ResultCache) -> None:
        self._odometry = odometry
        self._result_cache = result_cache

    def match(
        self, points: ScanPoints, guesses: list[Motion], *, alone: bool = False
    ) -> MotionEstimate | None:
        """Return the pose of the scan's base in the odometry frame, or None if nothing fits."""
        return self._result_cache.cached(
            MATCH, float(guesses[0].pose[0]), lambda: self._odometry.match(points, guesses, alone=alone)
        )

    def match_near(self, points: ScanPoints, pose: FloatArray) -> MotionEstimate | None:
        """Return the best pose of the scan close to ``pose`` (3,), however badly it fits."""
        return self._result_cache.cached(
            NEAR, float(pose[0]), lambda: self._odometry.match_near(points, pose)
        )

    def evidence(self, points: ScanPoints, pose: FloatArray, other: Motion) -> FloatArray:
        """Return (2, K) evidence of each object in a scan for a pose (3,) against another, in points."""
        return self._result_cache.cached(
            EVIDENCE, float(pose[0]), lambda: self._odometry.evidence(points, pose, other)
        )

    def add_keyframe(self, points: ScanPoints, pose: FloatArray) -> None:
        """Add a scan at a pose (3,) of the odometry frame to the local map."""
        self._odometry.add_keyframe(points, pose)
