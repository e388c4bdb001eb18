"""The robot's motion while it is localised, by the scans and wheels alone, and when that thread is cut."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.config import Config
from slam.localization.scan_view import ScanView
from slam.matching.planar import between
from slam.measurements import FloatArray, WheelOdometry
from slam.odometry import make_lidar_odometry
from slam.odometry.motion_tracker import MotionTracker, TrackedScan
from slam.odometry.wheel_tracker import WheelTracker

# So many scans in a row that match nothing cut the thread: wheels do not tell that a robot is carried.
_LOST_SCANS = 3
# A longer time between two scans is a gap in which anything may have happened.
_GAP_S = 5.0


@dataclass(frozen=True, slots=True)
class OdometryStep:
    """Where a scan was taken, by odometry.

    Attributes
    ----------
    pose
        (3,) in the odometry frame, which begins anew where ``broken``.
    step, covariance
        (3,) and (3, 3): motion since the last scan.
    broken
        Whether the motion since the last scan is not known; ``step`` means nothing then.
    """

    pose: FloatArray
    step: FloatArray
    covariance: FloatArray
    broken: bool


class ScanOdometry:
    """Scan to recent scans, with wheels where there are any."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._wheels = WheelTracker(config.wheels) if config.lidar_odometry.use_wheel_odometry else None
        self._tracker = self._new_tracker()
        self._last: TrackedScan | None = None
        self._keyframe: TrackedScan | None = None
        self._unmatched = 0
        self._stamp_s = 0.0

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)

    def add(self, view: ScanView) -> OdometryStep:
        """Take a scan."""
        tracked = self._tracker.track(view.points, view.stamp_s)
        last, elapsed_s = self._last, view.stamp_s - self._stamp_s
        self._stamp_s = view.stamp_s
        if last is not None and self._is_cut(last, tracked, elapsed_s):
            self._tracker, self._keyframe, self._unmatched = self._new_tracker(), None, 0
            tracked = self._tracker.track(view.points, view.stamp_s)
            last, broken = None, True
        else:
            broken = last is None
        self._last = tracked
        if last is None:
            step, covariance = np.zeros(3), np.zeros((3, 3))
        else:
            step = between(last.pose, tracked.pose)
            covariance = self._covariance(step, tracked)
        if self._moved_on(tracked):
            self._tracker.add_keyframe(view.points, tracked)
            self._keyframe = tracked
        return OdometryStep(tracked.pose, step, covariance, broken)

    def _new_tracker(self) -> MotionTracker:
        """A new odometry frame."""
        config = self._config
        odometry = make_lidar_odometry(config.lidar_odometry, config.match)
        return MotionTracker(odometry, self._wheels, config.prediction, config.match)

    def _is_cut(self, last: TrackedScan, tracked: TrackedScan, elapsed_s: float) -> bool:
        """Whether nothing tells how the robot moved."""
        if tracked.motion is not None:
            self._unmatched = 0
            return False
        self._unmatched += 1
        if self._wheels is None or last.wheel_pose is None or tracked.wheel_pose is None:
            return True
        plausible = self._wheels.plausible(between(last.wheel_pose, tracked.wheel_pose), elapsed_s)
        return not plausible or elapsed_s > _GAP_S or self._unmatched >= _LOST_SCANS

    def _covariance(self, step: FloatArray, tracked: TrackedScan) -> FloatArray:
        """Covariance (3, 3) of a step."""
        if tracked.motion is not None:
            return tracked.motion.covariance + tracked.dispute
        if self._wheels is not None:
            return self._wheels.covariance(step)
        lost = self._config.graph
        return np.diag([lost.lost_sigma_m**2, lost.lost_sigma_m**2, lost.lost_sigma_rad**2])

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to join the local map."""
        if self._keyframe is None:
            return True
        step = between(self._keyframe.pose, tracked.pose)
        limits = self._config.keyframes
        return bool(math.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)
