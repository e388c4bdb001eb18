"""Scan by scan motion: the lidar match where it is sure, the wheels where it is not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.matching.planar import between, compose
from slam.matching.scan_points import ScanPoints
from slam.measurements import FloatArray, MotionEstimate, row_from_pose2
from slam.odometry.lidar_odometry import Guess, LidarOdometry
from slam.odometry.wheel_tracker import WheelTracker

# A velocity is carried over at most this many times the step that it was measured over.
_GREATEST_STRETCH = 3.0


@dataclass(frozen=True, slots=True)
class TrackedScan:
    """Where a scan was taken, in the odometry frame.

    Attributes
    ----------
    pose
        (3,) x, y, yaw of the base.
    motion
        The lidar match; None where nothing fitted and the pose is dead reckoning.
    wheel_pose
        (3,) pose by the wheels alone at the scan's stamp, odom frame; None without wheels.
    """

    pose: FloatArray
    motion: MotionEstimate | None
    wheel_pose: FloatArray | None


class MotionTracker:
    """Predicts each scan's pose, matches it, and keeps the velocity."""

    def __init__(self, odometry: LidarOdometry, wheels: WheelTracker | None) -> None:
        self._odometry = odometry
        self._wheels = wheels
        self._last: TrackedScan | None = None
        self._stamp_s = 0.0
        self._velocity_step = np.zeros(3)
        self._velocity_step_s = 0.0

    def track(self, points: ScanPoints, stamp_s: float) -> TrackedScan:
        """Pose of the next scan; the first one is the origin of the odometry frame."""
        wheel_pose = self._wheels.pose_at(stamp_s) if self._wheels else None
        if self._last is None:
            tracked = TrackedScan(np.zeros(3), None, wheel_pose)
        else:
            step_s = stamp_s - self._stamp_s
            guesses = self._guesses(self._last, wheel_pose, step_s)
            motion = self._odometry.match(points, guesses)
            pose = guesses[0].pose if motion is None else row_from_pose2(motion.T_reference_base)
            tracked = TrackedScan(pose, motion, wheel_pose)
            self._velocity_step = between(self._last.pose, pose)
            self._velocity_step_s = step_s
        self._last = tracked
        self._stamp_s = stamp_s
        return tracked

    def add_keyframe(self, points: ScanPoints, tracked: TrackedScan) -> None:
        """Let the local map grow by a tracked scan."""
        self._odometry.add_keyframe(points, tracked.pose)

    def _guesses(self, last: TrackedScan, wheel_pose: FloatArray | None, step_s: float) -> list[Guess]:
        """Poses to try: by the wheels if a robot can move so, by constant velocity, and standing still."""
        guesses = []
        if self._wheels is not None and wheel_pose is not None and last.wheel_pose is not None:
            step = between(last.wheel_pose, wheel_pose)
            if self._wheels.plausible(step, step_s):
                guesses.append(Guess(compose(last.pose, step), self._wheels.covariance(step)))
        stretch = 1.0
        if step_s > 0.0 and self._velocity_step_s > 0.0:
            stretch = min(step_s / self._velocity_step_s, _GREATEST_STRETCH)
        guesses.append(Guess(compose(last.pose, self._velocity_step * stretch)))
        guesses.append(Guess(last.pose))
        return guesses
