"""Where in a known map a camera is: keyframes that look the same or should be in sight, verified."""

from __future__ import annotations

import gtsam
import numpy as np

from slam.config import Config
from slam.localization.known_map import KnownCameras
from slam.mapper.keyframe_store import KeyframeStore
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.place_recognition import PlaceIndex
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, unlikeness


class VisualLocator:
    """The camera keyframes of a map, by looks and by place.

    Parameters
    ----------
    cameras
        The keyframes.
    config
        The effective configuration; the bounds on a match are those of visual loops.
    """

    def __init__(self, cameras: KnownCameras, config: Config) -> None:
        self._poses = cameras.poses
        self._positions = np.array([pose.translation() for pose in cameras.poses]).reshape(-1, 3)
        self._axes = np.array([pose.rotation().matrix()[:, 2] for pose in cameras.poses]).reshape(-1, 3)
        self._store = KeyframeStore(config.rgbd, config.visual_loops.keyframes_cached, cameras.frames)
        self._matcher = FrameMatcher(config.rgbd_odometry)
        self._loops = config.visual_loops
        self._views = config.rgbd_odometry.views
        self._index = PlaceIndex(seed=config.seed)
        for key in range(len(cameras.poses)):
            self._index.add(cameras.frames.features(key).descriptors)

    def anywhere(self, frame: PreparedFrame) -> list[VisualMatch]:
        """Every place that the frame may show, none guessed: ``T_map_camera`` each, verified."""
        found = []
        looks = self._index.query(frame.features.descriptors, len(self._index), self._loops.by_looks)
        for place in looks:
            match = self._matcher.match_anywhere(frame, [self._keyframe(place.key)])
            if match is not None and self._is_sure(match):
                found.append(match)
        return found

    def near(self, frame: PreparedFrame, guess: gtsam.Pose3) -> VisualMatch | None:
        """``T_map_camera`` from a guess; None where no keyframe sees the same, or it does not fit."""
        local = [self._keyframe(key) for key in self._alike(frame, guess)]
        match = self._matcher.match(frame, local, guess) if local else None
        return match if match is not None and self._is_sure(match) else None

    def should_see(self, frame: PreparedFrame, guess: gtsam.Pose3) -> bool:
        """Whether a camera at the guess would see what a keyframe saw."""
        return bool(self._alike(frame, guess))

    def _alike(self, frame: PreparedFrame, guess: gtsam.Pose3) -> list[int]:
        """Keyframes whose cameras see most nearly the same as one at the guess, best first."""
        far = np.linalg.norm(self._positions - guess.translation(), axis=1) / frame.median_depth_m
        facing = self._axes @ guess.rotation().matrix()[:, 2]
        limit = self._loops.near_unlikeness
        possible = np.flatnonzero((far < limit) & (facing > 0.5)).tolist()
        scores = {key: unlikeness(self._poses[key], guess, frame.median_depth_m) for key in possible}
        near = sorted((key for key in possible if scores[key] < limit), key=lambda key: scores[key])
        return near[: self._views]

    def _keyframe(self, key: int) -> VisualKeyframe:
        """A keyframe with its images, where it stands in the map."""
        return VisualKeyframe(self._store.keyframe(key), self._poses[key])

    def _is_sure(self, match: VisualMatch) -> bool:
        """Whether a match is one of features, not of any corner of walls."""
        return (
            match.feature_count >= self._loops.least_features
            and match.motion.inlier_share >= self._loops.least_inlier_share
            and not match.motion.degenerate
        )
