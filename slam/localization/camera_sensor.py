"""Localise with a camera alone in a known map: by keyframes in view, with its own odometry in between."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.localization.poses import Measured, diagonal, separation
from slam.localization.sensor import Keyframe, Observation
from slam.localization.visual_locator import VisualLocator
from slam.measurements import Pose, composed
from slam.odometry.camera_odometry import camera_step, pose_in_segment
from slam.odometry.camera_track import CameraPose
from slam.odometry.rgbd_tracker import RgbdTracker
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame

# Evidence of an unmatched frame against a pose, nats: true poses often do not match either.
_UNMATCHED_NATS = -0.5


class CameraSensor:
    """A `Sensor`; it stores the median depth of a keyframe, m, and searches the place in every keyframe."""

    search_every_m = 0.0
    # No image is stored to judge later poses.
    weighs_back = 0
    least_keyframes = 2

    def __init__(self, locator: VisualLocator, config: Config) -> None:
        self._locator = locator
        self._odometry = RgbdTracker(FrameMatcher(config), config)
        self._new_parallax = 0.5 * config.rgbd_odometry.keyframe_parallax
        guessed = config.prediction.velocity_floor
        self._guess = Measured(locator.origin, diagonal(locator.origin, guessed, guessed))
        self._matched_nats = config.localization.lost_nats / self.least_keyframes
        self._last: CameraPose | None = None
        self._pose: Pose | None = None
        self._segment = 0

    def observe(self, measurement: Any, known: Pose | None) -> Observation[PreparedFrame] | None:
        """See `Sensor`; takes frames of the map's camera."""
        frame = self._locator.view(measurement)
        if frame is None:
            return None
        now = self._tracked(frame)
        step = camera_step(self._last, now)
        moved = None if step is None else self._locator.step(*step)
        self._last = now
        if moved is None or self._pose is None:
            self._pose = None if now is None else self._locator.origin
        else:
            self._pose = composed(self._pose, moved.pose)
        return Observation(frame.stamp_s, frame, self._pose, moved or self._guess, moved is None)

    def sees_new(self, view: PreparedFrame, before: Pose | None, pose: Pose) -> bool:
        """See `Sensor`."""
        if before is None:
            return True
        apart_m, turned_rad = separation(before, pose)
        return float(np.hypot(apart_m / view.median_depth_m, turned_rad)) > self._new_parallax

    def novel(self, view: PreparedFrame, pose: Pose, before: Sequence[Keyframe[float]] | None) -> float:
        """See `Sensor`."""
        return view.median_depth_m

    def align(self, view: PreparedFrame, guess: Pose) -> MotionEstimate | None:
        """See `Sensor`."""
        return self._locator.near(view, guess)

    def weigh(self, pose: Pose, novel: float, motion: MotionEstimate | None) -> float:
        """See `Sensor`."""
        if motion is not None:
            return self._matched_nats
        return _UNMATCHED_NATS if self._locator.should_see(novel, pose) else 0.0

    def propose(
        self, view: PreparedFrame, keyframes: Sequence[Keyframe[float]], within: Measured | None
    ) -> list[Pose]:
        """See `Sensor`."""
        return [motion.T_reference_base for motion in self._locator.anywhere(view)]

    def _tracked(self, frame: PreparedFrame) -> CameraPose | None:
        """Return the pose of the camera by its odometry; None if it is lost."""
        tracked = self._odometry.track(frame)
        self._segment += tracked.restarted
        if tracked.new_keyframe:
            self._odometry.add_keyframe(frame, tracked)
        return pose_in_segment(tracked, self._segment)
