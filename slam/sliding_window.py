"""Landmarks that several keyframes see, and the adjustment of the latest keyframes by them."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.answers import COMPUTED, Answers
from slam.config_stages import BundleConfig, RgbdOdometryConfig
from slam.graph.bundle_adjustment import WindowResult, WindowSettings, adjust_window
from slam.graph.landmarks import LandmarkObservations
from slam.graph.window_factors import PoseStep
from slam.measurements import FloatArray
from slam.vision.features import Features, match_features
from slam.vision.frame_matcher import FrameMatcher
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe

_NO_LANDMARK = -1


@dataclass(slots=True)
class _Member:
    """A keyframe of the window, and which landmark each of its features is."""

    frame: PreparedFrame
    pose: gtsam.Pose3
    landmarks: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class AdjustedStep:
    """The motion to the newest keyframe as the window tells it.

    Attributes
    ----------
    T_previous_newest, covariance
        And its covariance (6, 6), GTSAM's order, in the newest keyframe's frame.
    landmarks
        Sightings that agree.
    """

    T_previous_newest: gtsam.Pose3
    covariance: FloatArray
    landmarks: int


class SlidingWindow:
    """The latest keyframes of one camera (Yang2021 Eq. (7)-(12))."""

    def __init__(
        self, config: BundleConfig, matching: RgbdOdometryConfig, answers: Answers = COMPUTED
    ) -> None:
        self._config = config
        self._answers = answers
        self._matching = matching
        self._surfaces = FrameMatcher(matching, use_features=False)
        self._members: deque[_Member] = deque(maxlen=config.keyframes)
        self._steps: deque[PoseStep | None] = deque(maxlen=config.keyframes - 1)
        self._landmark_count = 0

    def restart(self) -> None:
        """Forget everything: tracking was lost."""
        self._members.clear()
        self._steps.clear()

    def add(self, frame: PreparedFrame, pose: gtsam.Pose3) -> AdjustedStep | None:
        """Take the next keyframe and adjust the window.

        Parameters
        ----------
        pose
            ``T_odom_camera`` as tracked.

        Returns
        -------
        None where there is nothing to adjust, or nothing that determines it.
        """
        newest = _Member(frame, pose, np.full(len(frame.features), _NO_LANDMARK, np.int64))
        for member in list(self._members)[-self._config.linked :]:
            self._link(member, newest)
        if self._members:
            self._steps.append(self._surface_step(self._members[-1], newest))
        self._members.append(newest)
        if len(self._members) < 2:
            return None
        poses = [member.pose for member in self._members]
        steps = [
            PoseStep(number, number + 1, step.T_source_target, step.covariance)
            for number, step in enumerate(self._steps)
            if step is not None
        ]
        settings = WindowSettings(most_landmarks=self._config.landmarks)
        sightings, intrinsics = self._sightings(), frame.frame.intrinsics
        result = self._answers.ask(
            "window", pose.x(), lambda: adjust_window(poses, sightings, intrinsics, steps, settings)
        )
        if not isinstance(result, WindowResult) or not result.converged:
            return None
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(result.covariance_previous[3:, 3:])[-1]))
        if not sigma_m < self._matching.degenerate_sigma_m:
            return None
        for member, adjusted in zip(self._members, result.poses, strict=True):
            member.pose = adjusted
        step = result.poses[-2].between(result.poses[-1])
        floor = [self._matching.floor_rad**2] * 3 + [self._matching.floor_m**2] * 3
        covariance = result.covariance_previous + np.diag(floor)
        return AdjustedStep(step, covariance, int(result.inliers.sum()))

    def _link(self, member: _Member, newest: _Member) -> None:
        """Give the features of the newest keyframe the landmarks of those that they match."""
        pairs = match_features(
            member.frame.features.descriptors,
            newest.frame.features.descriptors,
            self._matching.match_ratio,
            self._matching.match_bits,
        )
        pairs = pairs.where(self._explained(member, newest, pairs.first, pairs.second))
        new = member.landmarks[pairs.first] == _NO_LANDMARK
        count = int(new.sum())
        member.landmarks[pairs.first[new]] = np.arange(self._landmark_count, self._landmark_count + count)
        self._landmark_count += count
        free = newest.landmarks[pairs.second] == _NO_LANDMARK
        # A landmark shows itself once in an image.
        free &= ~np.isin(member.landmarks[pairs.first], newest.landmarks)
        newest.landmarks[pairs.second[free]] = member.landmarks[pairs.first[free]]

    def _explained(
        self, member: _Member, newest: _Member, first: NDArray[np.int64], second: NDArray[np.int64]
    ) -> NDArray[np.bool_]:
        """Which pairs the tracked motion explains."""
        intrinsics = newest.frame.frame.intrinsics
        known, seen = member.frame.features, newest.frame.features
        step = newest.pose.between(member.pose)
        points = known.points_camera(member.frame.frame.intrinsics)[first]
        points = points @ step.rotation().matrix().T + step.translation()
        depth = np.maximum(points[:, 2], 1e-3)
        u = intrinsics.fx * points[:, 0] / depth + intrinsics.cx
        v = intrinsics.fy * points[:, 1] / depth + intrinsics.cy
        error = np.hypot(u - seen.pixels[second, 0], v - seen.pixels[second, 1])
        close = error < self._config.gate_px * seen.sigma_px[second]
        return np.asarray(close & (known.depth_m[first] > 0.0) & (points[:, 2] > 0.0))

    def _surface_step(self, member: _Member, newest: _Member) -> PoseStep | None:
        """What the surfaces alone tell of the motion to the newest keyframe."""
        local = [VisualKeyframe(member.frame, gtsam.Pose3())]
        guess = member.pose.between(newest.pose)
        match = self._answers.ask(
            "surfaces", guess.x(), lambda: self._surfaces.match(newest.frame, local, guess)
        )
        return None if match is None else PoseStep(0, 1, match.pose, match.motion.covariance)

    def _sightings(self) -> LandmarkObservations:
        """Every sighting of every landmark in the window."""
        keyframes, landmarks, features = [], [], []
        for number, member in enumerate(self._members):
            named = member.landmarks != _NO_LANDMARK
            keyframes.append(np.full(int(named.sum()), number))
            landmarks.append(member.landmarks[named])
            features.append(member.frame.features.where(named))
        return LandmarkObservations(
            np.concatenate(keyframes),
            np.concatenate(landmarks),
            *(_joined(features, name) for name in ("pixels", "depth_m", "sigma_px")),
        )


def _joined(features: list[Features], name: str) -> FloatArray:
    """One column of several sets of features."""
    return np.concatenate([getattr(part, name) for part in features]).astype(np.float64)
