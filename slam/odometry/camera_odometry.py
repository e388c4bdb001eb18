"""Odometry of one camera of a robot, which gives the motion between two times."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config import Config
from slam.measurements import FloatArray
from slam.odometry.camera_track import CameraPose, CameraTrack
from slam.odometry.rgbd_tracker import RgbdTracker, TrackedFrame
from slam.result_cache import COMPUTED, ResultCache
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame


class CameraOdometry:
    """Tracks a camera's frames and stores their poses."""

    def __init__(self, config: Config, result_cache: ResultCache = COMPUTED) -> None:
        self._tracker = RgbdTracker(FrameMatcher(config), config, result_cache)
        self._segment = 0
        self.track = CameraTrack()
        self.lost_frames = 0
        self.frames = 0

    def add(self, frame: PreparedFrame) -> TrackedFrame:
        """Track the next frame."""
        tracked = self._tracker.track(frame)
        self.frames += 1
        if tracked.restarted:
            self._segment += 1
        if (pose := pose_in_segment(tracked, self._segment)) is not None:
            self.track.add(frame.stamp_s, pose)
        else:
            self.track.lose()
            self.lost_frames += 1
        if tracked.new_keyframe:
            self._tracker.add_keyframe(frame, tracked)
        return tracked


def pose_in_segment(tracked: TrackedFrame, segment: int) -> CameraPose | None:
    """Return the pose of a frame; None if the odometry was lost."""
    if tracked.match is not None:
        return CameraPose(tracked.pose, tracked.match.motion.covariance, segment)
    # The first frame of a segment is its origin, without error.
    return CameraPose(tracked.pose, np.zeros((6, 6)), segment) if tracked.new_keyframe else None


def camera_step(before: CameraPose | None, after: CameraPose | None) -> tuple[gtsam.Pose3, FloatArray] | None:
    """Return the motion of a camera between two times with its covariance (6, 6); None if unknown."""
    if before is None or after is None or before.segment != after.segment:
        return None
    motion = before.pose.between(after.pose)
    adjoint = motion.inverse().AdjointMap()
    return motion, adjoint @ before.covariance @ adjoint.T + after.covariance
