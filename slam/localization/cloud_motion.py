"""The robot's motion while it is localised, by its clouds and wheels alone, and when that thread is cut."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.body import Measured
from slam.measurements import FloatArray, PointCloud, WheelOdometry
from slam.odometry.cloud_tracker import CloudTracker, TrackedCloud
from slam.odometry.wheel_tracker import WheelTracker

# So many clouds in a row that match nothing cut the thread: no guess tells that a robot is carried.
_LOST_CLOUDS = 3
# A longer time between two clouds is a gap in which anything may have happened.
_GAP_S = 5.0
# Sigmas of a step that was guessed: radians and metres a cloud.
_GUESSED = np.array([0.01, 0.01, 0.05, 0.05, 0.05, 0.02])


@dataclass(frozen=True, slots=True)
class CloudStep:
    """Where a cloud was taken, by odometry.

    Attributes
    ----------
    points
        (N, 3) usable points, base frame, deskewed.
    pose
        ``T_odom_base``; the odometry frame begins anew where ``broken``.
    moved
        Motion since the last cloud.
    broken
        Whether the motion since the last cloud is not known; ``moved`` means nothing then.
    """

    points: FloatArray
    pose: gtsam.Pose3
    moved: Measured
    broken: bool


class CloudMotion:
    """Cloud to recent clouds."""

    def __init__(self, config: Config) -> None:
        self._config = config.cloud_odometry
        self._wheels = WheelTracker(config.wheels) if self._config.use_wheel_odometry else None
        self._tracker = CloudTracker(self._config, self._wheels)
        self._last: TrackedCloud | None = None
        self._unmatched = 0
        self._stamp_s = 0.0

    def add_wheels(self, reading: WheelOdometry) -> None:
        """Take a wheel reading."""
        if self._wheels is not None:
            self._wheels.add(reading)

    def add(self, cloud: PointCloud) -> CloudStep:
        """Take a cloud."""
        last, elapsed_s = self._last, cloud.stamp_s - self._stamp_s
        self._stamp_s = cloud.stamp_s
        gap = last is not None and not 0.0 <= elapsed_s <= _GAP_S
        tracked = None if gap else self._tracker.track(cloud)
        if tracked is not None:
            first = last is None or tracked.motion is not None
            self._unmatched = 0 if first else self._unmatched + 1
        if tracked is None or self._unmatched >= _LOST_CLOUDS:
            self._tracker, self._unmatched, last = CloudTracker(self._config, self._wheels), 0, None
            tracked = self._tracker.track(cloud)
        if tracked.new_keyframe:
            self._tracker.add_keyframe(tracked)
        self._last = tracked
        if last is None:
            return CloudStep(tracked.points, tracked.pose, Measured(gtsam.Pose3(), np.zeros((6, 6))), True)
        step = last.pose.between(tracked.pose)
        return CloudStep(
            tracked.points, tracked.pose, Measured(step, _covariance(last, tracked, step)), False
        )


def _covariance(last: TrackedCloud, tracked: TrackedCloud, step: gtsam.Pose3) -> FloatArray:
    """(6, 6) of a step between two clouds, each matched to the same recent ones."""
    if tracked.motion is None:
        return np.diag(_GUESSED**2)
    before = np.zeros((6, 6))
    if last.motion is not None:
        adjoint = step.inverse().AdjointMap()
        before = adjoint @ last.motion.covariance @ adjoint.T
    return np.asarray(before + tracked.motion.covariance)
