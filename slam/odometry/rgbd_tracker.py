"""Track an RGB-D camera frame by frame against a local map of keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np

from slam.config import Config
from slam.odometry.constant_velocity import stretch
from slam.odometry.rgbd_odometry import RgbdOdometry
from slam.result_cache import COMPUTED, ResultCache
from slam.vision.feature_pose import turn_from_features
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, dissimilarity

FRAME = "frame"  # name of its queries


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Pose of a frame.

    Attributes
    ----------
    pose
        ``T_odom_camera``.
    match
        None if nothing fits and the pose is a guess, and for the first frame.
    new_keyframe
        Whether it should become a keyframe.
    restarted
        Whether tracking was lost and restarts here: the motion since the last keyframe is a guess.
    """

    pose: gtsam.Pose3
    match: VisualMatch | None
    new_keyframe: bool
    restarted: bool


class RgbdTracker:
    """Predicts and matches the pose of each frame, and selects keyframes."""

    def __init__(self, odometry: RgbdOdometry, config: Config, result_cache: ResultCache = COMPUTED) -> None:
        self._odometry = odometry
        self._result_cache = result_cache
        self._config = config
        self._local: list[VisualKeyframe] = []
        # Keyframes of the local map with surfaces in memory, the most recently used last.
        self._in_use: list[VisualKeyframe] = []
        self._last: TrackedFrame | None = None
        self._before: PreparedFrame | None = None
        self._stamp_s = 0.0
        self._matched_s = 0.0
        self._step = gtsam.Pose3()
        self._step_s = 0.0
        self._lost = 0
        self._noises: list[float] = []

    def track(self, frame: PreparedFrame) -> TrackedFrame:
        """Return the pose of the next frame; the first one is the origin of the odometry frame."""
        if self._last is None:
            tracked = TrackedFrame(gtsam.Pose3(), None, new_keyframe=True, restarted=False)
        else:
            step_s = frame.stamp_s - self._stamp_s
            guess = self._last.pose.compose(self._velocity_step(step_s))
            tracked = self._match(frame, guess)
            self._step = self._last.pose.between(tracked.pose) if tracked.match else gtsam.Pose3()
            # The previous pose is that of the last matched frame, however many were lost since.
            self._step_s = frame.stamp_s - self._matched_s
        if tracked.match is not None or tracked.new_keyframe:
            self._matched_s = frame.stamp_s
        self._last, self._before = tracked, frame
        self._stamp_s = frame.stamp_s
        return tracked

    def add_keyframe(self, frame: PreparedFrame, tracked: TrackedFrame) -> None:
        """Add a tracked frame to the local map; after a restart, it is the only one."""
        if tracked.restarted:
            self._local.clear()
        if tracked.match is not None:
            config = self._config.rgbd_odometry
            sigma_m = config.depth_floor_m + config.depth_share * frame.median_depth_m**2
            self._noises.append(tracked.match.motion.residual_m / sigma_m)
            del self._noises[: -self._config.match.local_map_keyframes]
        noise = float(np.median(self._noises)) if self._noises else 1.0
        self._local.append(VisualKeyframe(frame, tracked.pose, noise))
        del self._local[: -self._config.match.local_map_keyframes]

    def _velocity_step(self, step_s: float) -> gtsam.Pose3:
        """Return the last step, scaled to the elapsed time."""
        if step_s <= 0.0 or self._step_s <= 0.0:
            return gtsam.Pose3()
        return gtsam.Pose3.Expmap(stretch(step_s, self._step_s) * gtsam.Pose3.Logmap(self._step))

    def _match(self, frame: PreparedFrame, guess: gtsam.Pose3) -> TrackedFrame:
        """Match to the most similar keyframes, or mark the frame as lost."""
        match = self._cached(frame, guess)
        if match is None:
            # A camera that was held still or shaken did not move at constant velocity.
            guess = self._turned(frame)
            match = self._cached(frame, guess)
        if match is None or (self._lost and not self._found_again(match)):
            self._lost += 1
            restart = self._lost >= self._config.match.lost_after and self._can_be_matched_to(frame)
            if restart:
                self._lost = 0
            return TrackedFrame(guess, None, new_keyframe=restart, restarted=restart)
        self._lost = 0
        pose = match.pose
        return TrackedFrame(pose, match, self._moved_on(pose, match), restarted=False)

    def _turned(self, frame: PreparedFrame) -> gtsam.Pose3:
        """Return the last pose, rotated by the rotation between the two images, which needs no depth."""
        assert self._last is not None and self._before is not None
        turn = turn_from_features(
            self._before.features, frame.features, frame.frame.intrinsics, self._config.rgbd_odometry
        )
        return self._last.pose.compose(gtsam.Pose3(turn, np.zeros(3)))

    def _can_be_matched_to(self, frame: PreparedFrame) -> bool:
        """Return whether a frame has enough depth to start a local map."""
        config = self._config.rgbd_odometry
        known = np.count_nonzero(frame.features.depth_m > 0.0)
        return bool(known >= config.least_inliers) or len(frame.points) >= config.least_points

    def _cached(self, frame: PreparedFrame, guess: gtsam.Pose3) -> VisualMatch | None:
        """Match from a guess."""
        return self._result_cache.cached(
            FRAME, guess.x(), lambda: self._odometry.match(frame, self._most_alike(guess), guess)
        )

    def _found_again(self, match: VisualMatch) -> bool:
        """Return whether a match ends a loss: walls look alike without texture or a corner."""
        if match.feature_count >= self._config.rgbd_odometry.least_inliers:
            return True
        return match.motion.converged and not match.motion.degenerate

    def _most_alike(self, pose: gtsam.Pose3) -> list[VisualKeyframe]:
        """Return the keyframes of the local map with the most similar views, best first."""
        scores = [
            dissimilarity(keyframe.pose, pose, keyframe.frame.median_depth_m) for keyframe in self._local
        ]
        views = self._config.rgbd_odometry.views
        order = np.argsort(scores, kind="stable")[:views]
        close = [self._local[n] for n in order if n == order[0] or scores[n] < 1.0]
        self._in_use = [one for one in self._in_use if not any(one is other for other in close)] + close
        for unused in self._in_use[: -2 * views]:
            unused.frame.forget_surface()
        del self._in_use[: -2 * views]
        return close

    def _moved_on(self, pose: gtsam.Pose3, match: VisualMatch) -> bool:
        """Return whether parallax, rotation or lost overlap require a keyframe."""
        config = self._config.rgbd_odometry
        if match.overlap < config.keyframe_overlap:
            return True
        for keyframe in self._local:
            step = keyframe.pose.between(pose)
            parallax = float(np.linalg.norm(step.translation())) / keyframe.frame.median_depth_m
            turn = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
            if parallax < config.keyframe_parallax and turn < self._config.keyframes.angle_rad:
                return False
        return True
