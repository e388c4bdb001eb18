"""One camera of a robot: its own odometry, asked for the motion between two moments."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.answers import COMPUTED, Answers
from slam.config_stages import RgbdOdometryConfig
from slam.measurements import FloatArray
from slam.odometry.rgbd_odometry import make_rgbd_odometry
from slam.odometry.rgbd_tracker import RgbdTracker, TrackedFrame
from slam.vision.prepared_frame import PreparedFrame

# Beyond this the newest frame is too old to be carried on by its own speed.
_LONGEST_EXTRAPOLATION_S = 0.25
# A pose carried on is unsure by this share of what it was carried.
_EXTRAPOLATION_SHARE = 0.2
# Sigma of the time between two sensors' stamps: no two clocks agree, and exposures take their time.
_CLOCK_S = 0.01
# Sigma of the speed of a camera that was matched but once: radians and metres a second.
_UNKNOWN_SPEED = 0.5


@dataclass(frozen=True, slots=True)
class CameraPose:
    """Where a camera was at some moment.

    Attributes
    ----------
    pose
        ``T_odom_camera``.
    covariance
        (6, 6) of the pose against the local map, GTSAM's order, camera frame.
    segment
        Poses of different segments have no known motion between them.
    """

    pose: gtsam.Pose3
    covariance: FloatArray
    segment: int


class CameraOdometry:
    """Tracks a camera's frames and remembers the newest."""

    def __init__(self, config: RgbdOdometryConfig, answers: Answers = COMPUTED) -> None:
        self._tracker = RgbdTracker(make_rgbd_odometry(config), config, answers)
        self._segment = 0
        self._stamp_s = -np.inf
        self._newest: CameraPose | None = None
        self._twist: FloatArray | None = None
        self.lost_frames = 0
        self.frames = 0

    def add(self, frame: PreparedFrame) -> TrackedFrame:
        """Track the next frame."""
        tracked = self._tracker.track(frame)
        self.frames += 1
        if tracked.restarted:
            self._segment += 1
        before, step_s = self._newest, frame.stamp_s - self._stamp_s
        self._newest, self._twist = None, None
        if tracked.match is not None:
            self._newest = CameraPose(tracked.pose, tracked.match.motion.covariance, self._segment)
            if before is not None and 0.0 < step_s < _LONGEST_EXTRAPOLATION_S:
                self._twist = gtsam.Pose3.Logmap(before.pose.between(tracked.pose)) / step_s
        elif tracked.new_keyframe:
            # The beginning of a segment is its origin, and exact.
            self._newest = CameraPose(tracked.pose, np.zeros((6, 6)), self._segment)
        else:
            self.lost_frames += 1
        self._stamp_s = frame.stamp_s
        if tracked.new_keyframe:
            self._tracker.add_keyframe(frame, tracked)
        return tracked

    def at(self, stamp_s: float) -> CameraPose | None:
        """The camera at a stamp at or shortly after its newest frame; None where that is not known."""
        ahead_s = stamp_s - self._stamp_s
        if self._newest is None or not 0.0 <= ahead_s < _LONGEST_EXTRAPOLATION_S:
            return None
        carried = np.zeros(6) if self._twist is None else self._twist * ahead_s
        twist = np.zeros(6) if self._twist is None else self._twist
        sigmas = np.abs(twist) * np.hypot(_EXTRAPOLATION_SHARE * ahead_s, _CLOCK_S)
        if self._twist is None:
            sigmas = np.full(6, _UNKNOWN_SPEED * ahead_s)
        doubt = np.diag(sigmas**2)
        pose = self._newest.pose.compose(gtsam.Pose3.Expmap(carried))
        return CameraPose(pose, self._newest.covariance + doubt, self._segment)


def camera_step(before: CameraPose | None, after: CameraPose | None) -> tuple[gtsam.Pose3, FloatArray] | None:
    """Motion of a camera between two moments with its covariance (6, 6); None where it is not known."""
    if before is None or after is None or before.segment != after.segment:
        return None
    motion = before.pose.between(after.pose)
    adjoint = motion.inverse().AdjointMap()
    return motion, adjoint @ before.covariance @ adjoint.T + after.covariance
