"""Locate a camera in a known map by keyframes that look similar or should be in view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from slam.config import Config
from slam.estimates import MotionEstimate
from slam.localization.poses import Measured
from slam.mapper.keyframe_store import KeyframeStore
from slam.measurements import FloatArray, Measurement, Pose, RgbdFrame, pose2_from_row
from slam.storage.map_contents import MapContents
from slam.vision.camera_frame import T_BODY_CAMERA
from slam.vision.color_registration import ColorRegistration
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.learned_camera import LearnedCamera
from slam.vision.place_recognition import PlaceIndex
from slam.vision.planar_motion import planar_motion
from slam.vision.prepared_frame import FramePreparer, PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, dissimilarity


class VisualLocator:
    """Locate a camera by the camera keyframes of a map, by appearance and by position.

    Parameters
    ----------
    known
        A map with camera keyframes.
    config
        The configuration; the limits for a match are those of visual loops.
    registrations
        Pose of each colour camera relative to its depth camera, by camera name; None uses those that the
        mapping run estimated.
    """

    def __init__(
        self, known: MapContents, config: Config, registrations: Mapping[str, ColorRegistration] | None = None
    ) -> None:
        assert known.frames is not None
        self.origin: Pose = gtsam.Pose2() if known.planar else gtsam.Pose3()
        self._T_base_camera: gtsam.Pose3 | None = None
        first = known.frames.head(0)
        self._sensor, learned = first.sensor, known.cameras.get(first.sensor, LearnedCamera())
        # If the log does not contain the mounting, that of the map is used.
        none = T_BODY_CAMERA if known.planar else gtsam.Pose3()
        self._mapped_mounting = learned.T_base_camera or first.T_base_camera or none
        self._prepare = FramePreparer(
            config.rgbd, known.registrations if registrations is None else registrations
        )
        self._poses = known.frame_poses()
        self._positions = np.array([pose.translation() for pose in self._poses])
        self._axes = np.array([pose.rotation().matrix()[:, 2] for pose in self._poses])
        self._store = KeyframeStore(config.rgbd, config.match.local_map_keyframes, known.frames)
        self._matcher = FrameMatcher(config)
        self._loops, self._images = config.loops, config.visual_loops
        self._views = config.rgbd_odometry.views
        self._index = PlaceIndex(config.seed)
        for key in range(len(known.frames)):
            self._index.add(known.frames.features(key).descriptors)

    def view(self, measurement: Measurement | PreparedFrame) -> PreparedFrame | None:
        """Return a prepared frame of the map's camera; None for anything else."""
        prepared = self._prepare(measurement) if isinstance(measurement, RgbdFrame) else measurement
        if not isinstance(prepared, PreparedFrame) or prepared.frame.sensor != self._sensor:
            return None
        if self._T_base_camera is None:
            self._T_base_camera = prepared.frame.T_base_camera or self._mapped_mounting
        return prepared

    def anywhere(self, frame: PreparedFrame) -> list[MotionEstimate]:
        """Return all places that the frame may show, without a guess: ``T_map_base`` of each, verified."""
        motions = []
        similar = self._index.query(frame.features.descriptors, len(self._index), self._loops.by_appearance)
        for place in similar:
            match = self._matcher.match_anywhere(frame, [self._keyframe(place.key)])
            motions.append(self._believed(match))
        return [motion for motion in motions if motion is not None]

    def near(self, frame: PreparedFrame, guess: Pose) -> MotionEstimate | None:
        """Find ``T_map_base`` from a guess; return None if no keyframe sees the same, or it does not fit."""
        camera = self._camera_of(guess)
        local = [self._keyframe(key) for key in self._alike(frame.median_depth_m, camera)]
        return self._believed(self._matcher.match(frame, local, camera)) if local else None

    def should_see(self, depth_m: float, guess: Pose) -> bool:
        """Return whether a camera of the body at ``T_map_base`` would see what a keyframe saw at a depth."""
        return bool(self._alike(depth_m, self._camera_of(guess)))

    def step(self, motion: gtsam.Pose3, covariance: FloatArray) -> Measured | None:
        """Return the motion of the body from that of its camera; None if the body cannot move so."""
        return self._of_body(motion, covariance, self._mounting)

    @property
    def _mounting(self) -> gtsam.Pose3:
        """``T_base_camera``."""
        assert self._T_base_camera is not None, "no frame yet"
        return self._T_base_camera

    def _of_body(self, motion: gtsam.Pose3, covariance: FloatArray, T_a_b: gtsam.Pose3) -> Measured | None:
        """Return ``T_a_base`` from ``T_b_camera``; on a floor, projected to it, or None if it leaves it."""
        mounting = self._mounting
        if isinstance(self.origin, gtsam.Pose2):
            planar = planar_motion(motion, covariance, mounting, T_a_b)
            if planar.leaves_the_floor:
                return None
            return Measured(pose2_from_row(planar.motion), planar.covariance)
        adjoint = mounting.AdjointMap()
        moved = T_a_b.compose(motion).compose(mounting.inverse())
        return Measured(moved, adjoint @ covariance @ adjoint.T)

    def _camera_of(self, pose: Pose) -> gtsam.Pose3:
        """Return ``T_map_camera`` for a pose of the body."""
        spatial = gtsam.Pose3(pose) if isinstance(pose, gtsam.Pose2) else pose
        return spatial.compose(self._mounting)

    def _alike(self, depth_m: float, guess: gtsam.Pose3) -> list[int]:
        """Return keyframes whose cameras see most of what a camera at the guess sees, best first."""
        distance = np.linalg.norm(self._positions - guess.translation(), axis=1) / depth_m
        facing = self._axes @ guess.rotation().matrix()[:, 2]
        limit = self._images.near_dissimilarity
        possible = np.flatnonzero((distance < limit) & (facing > 0.5)).tolist()
        scores = {key: dissimilarity(self._poses[key], guess, depth_m) for key in possible}
        best = sorted((key for key in possible if scores[key] < limit), key=lambda key: scores[key])
        return best[: self._views]

    def _keyframe(self, key: int) -> VisualKeyframe:
        """Return a keyframe with its images, at its pose in the map."""
        return VisualKeyframe(self._store.keyframe(key), self._poses[key])

    def _believed(self, match: VisualMatch | None) -> MotionEstimate | None:
        """Return ``T_map_base`` of a match, if features support it, not only the shape of walls."""
        if match is None or match.motion.degenerate or match.feature_count < self._images.least_features:
            return None
        if match.motion.inlier_share < self._loops.least_inlier_share:
            return None
        base = self._of_body(match.pose, match.motion.covariance, gtsam.Pose3())
        if base is None:
            return None
        return replace(match.motion, T_reference_base=base.pose, covariance=base.covariance)
