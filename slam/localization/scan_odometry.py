"""The robot's motion while it is localised, by the scans and wheels alone, and when that thread is cut."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from slam.config import Config
from slam.localization.scan_view import ScanView
from slam.matching.planar import between, compose
from slam.measurements import FloatArray, WheelOdometry
from slam.odometry.motion_tracker import MotionTracker, TrackedScan
from slam.odometry.surfel_odometry import SurfelOdometry
from slam.odometry.wheel_tracker import WheelTracker

# So many scans in a row that match nothing cut the thread: wheels do not tell that a robot is carried.
_LOST_SCANS = 3
# Squared sigmas up to which match and expectation tell the same (three degrees of freedom, 99.9 %).
_AGREE = 16.0
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
        self._step = np.zeros(3)

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)

    def expected_step(self, stamp_s: float) -> tuple[FloatArray, FloatArray]:
        """Motion (3,) from the last scan to one at a stamp, with its covariance (3, 3), before it is matched.

        By the wheels; as before, where they say nothing.
        """
        step, step_s = self._step, stamp_s - self._stamp_s
        if self._wheels is not None and self._last is not None and self._last.wheel_pose is not None:
            now = self._wheels.pose_at(stamp_s)
            turned = None if now is None else between(self._last.wheel_pose, now)
            if turned is not None and self._wheels.plausible(turned, step_s):
                return turned, self._wheels.covariance(turned) * self._tracker.wheel_doubt
        config = self._config.prediction
        sigma_m = config.velocity_floor_m + config.velocity_share * math.hypot(step[0], step[1])
        sigma_rad = config.velocity_floor_rad + config.velocity_share * abs(float(step[2]))
        return step, np.diag([sigma_m**2, sigma_m**2, sigma_rad**2])

    def add(self, view: ScanView) -> OdometryStep:
        """Take a scan."""
        expected = self.expected_step(view.stamp_s)
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
        self._step, covariance = np.zeros(3), np.zeros((3, 3))
        if last is not None:
            self._step, covariance = self._fused(between(last.pose, tracked.pose), tracked, expected)
        if self._moved_on(tracked):
            self._tracker.add_keyframe(view.points, tracked)
            self._keyframe = tracked
        return OdometryStep(tracked.pose, self._step, covariance, broken)

    def _new_tracker(self) -> MotionTracker:
        """A new odometry frame."""
        config = self._config
        odometry = SurfelOdometry(config.lidar_odometry, config.match)
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

    def _fused(
        self, step: FloatArray, tracked: TrackedScan, expected: tuple[FloatArray, FloatArray]
    ) -> tuple[FloatArray, FloatArray]:
        """A step by match and expectation, each by its covariance: wheels tell how long a corridor is."""
        if tracked.motion is None:
            return expected
        matched = tracked.motion.covariance + tracked.dispute
        offset = between(step, expected[0])
        both = matched + expected[1]
        if offset @ np.linalg.solve(both, offset) > _AGREE:
            return step, matched
        gain = matched @ np.linalg.inv(both)
        return compose(step, gain @ offset), matched - gain @ matched

    def _moved_on(self, tracked: TrackedScan) -> bool:
        """Whether a scan is far enough from the last keyframe to join the local map."""
        if self._keyframe is None:
            return True
        step = between(self._keyframe.pose, tracked.pose)
        limits = self._config.keyframes
        return bool(math.hypot(step[0], step[1]) > limits.distance_m or abs(step[2]) > limits.angle_rad)
