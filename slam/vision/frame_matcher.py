"""Match a frame to keyframes by surfaces and features; use PnP-RANSAC if the initial guess is too far off."""

from __future__ import annotations

import gtsam
import numpy as np

from fusion.estimation import gate
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.measurements import CameraIntrinsics, FloatArray
from slam.vision.feature_pose import pose_from_features
from slam.vision.features import Features, Matches, match_features
from slam.vision.guided_matching import match_near
from slam.vision.joint_alignment import JointAlignment, Landmarks, View, align
from slam.vision.prepared_frame import PreparedFrame
from slam.vision.visual_match import VisualKeyframe, VisualMatch, covariance_of


class FrameMatcher:
    """Matcher without state except its settings."""

    def __init__(self, settings: Config) -> None:
        self._match, self._config = settings.match, settings.rgbd_odometry
        self._least_overlap = settings.loops.least_overlap

    def match(
        self, frame: PreparedFrame, local: list[VisualKeyframe], guess: gtsam.Pose3
    ) -> VisualMatch | None:
        """See `slam.odometry.rgbd_odometry.RgbdOdometry`."""
        config = self._config
        known = local[: config.feature_views]
        landmarks = self._landmarks(frame, known, guess)
        anywhere = len(landmarks.points) < config.least_inliers
        if anywhere:
            # Features found elsewhere contradict the guess; at their expected position they are not seen.
            landmarks = self._landmarks(frame, known)
        best = self._align(frame, local, landmarks, guess, self._match.coarse_iterations)
        least = self._match.confident_inlier_share
        unlike = self._support(best.pose, landmarks, frame) < least * len(landmarks.points)
        if unlike or self._share(best) < least or not best.converged:
            landmarks = landmarks if anywhere else self._landmarks(frame, known)
            best = self._better(best, self._by_features(frame, local, landmarks), landmarks, frame)
        return self._judge(self._without_walkers(best, frame, local, landmarks))

    def _without_walkers(
        self, best: JointAlignment, frame: PreparedFrame, local: list[VisualKeyframe], landmarks: Landmarks
    ) -> JointAlignment:
        """Return an alignment, or one near that of features alone, if these contradict it.

        A person in front of the camera shifts the alignment of surfaces, but not of features: near theirs,
        only surfaces within one sigma count.
        """
        config, alone = self._config, self._align(frame, [], landmarks, best.pose, 0).pose
        least = self._support(best.pose, landmarks, frame)
        least += gate(6) * config.correlated_features / (2 * config.kernel_sigmas**2)
        if self._support(alone, landmarks, frame) < least:
            return best
        near = self._align(frame, local, landmarks, alone, 0, 1.0 / config.kernel_sigmas)
        if self._support(near.pose, landmarks, frame) < least or self._judge(near) is None:
            return best
        # Where nobody walks, surfaces fit best at their own pose.
        return near if near.residual_m < best.residual_m else best

    def _better(
        self, best: JointAlignment, others: list[JointAlignment], landmarks: Landmarks, frame: PreparedFrame
    ) -> JointAlignment:
        """Return the valid match with most feature inliers."""
        accepted = [match for match in others if self._judge(match) is not None]
        return max([best, *accepted], key=lambda match: self._support(match.pose, landmarks, frame))

    def match_anywhere(self, frame: PreparedFrame, local: list[VisualKeyframe]) -> VisualMatch | None:
        """Estimate the pose of the frame's camera without a guess; None if too few features agree."""
        matches = self._by_features(frame, local, self._landmarks(frame, local))
        return self._judge(matches[0]) if matches else None

    def _by_features(
        self, frame: PreparedFrame, local: list[VisualKeyframe], landmarks: Landmarks
    ) -> list[JointAlignment]:
        """Align from the pose of PnP-RANSAC within the accuracy of features; None if too few agree."""
        solved = pose_from_features(
            landmarks.points,
            landmarks.pixels,
            frame.frame.intrinsics,
            self._config.kernel_sigmas,  # the accuracy of a keypoint is a pixel
            self._config.least_inliers,
        )
        if solved is None:
            return []
        return [self._align(frame, local, landmarks, solved.T_reference_camera, 0)]

    def _support(self, pose: gtsam.Pose3, landmarks: Landmarks, frame: PreparedFrame) -> float:
        """Return how many features agree with a pose, with Geman-McClure weights."""
        off_px = project(landmarks.points, pose.inverse(), frame.frame.intrinsics) - landmarks.pixels
        sigmas = np.linalg.norm(off_px, axis=1) / (np.sqrt(2.0) * landmarks.sigma_px)
        return float(np.nansum(1.0 / (1.0 + (sigmas / self._config.kernel_sigmas) ** 2)))

    def _landmarks(
        self, frame: PreparedFrame, keyframes: list[VisualKeyframe], guess: gtsam.Pose3 | None = None
    ) -> Landmarks:
        """Return features of the keyframes found in the frame, near the position predicted by a guess."""
        if not keyframes:
            return Landmarks.none()
        points, pixels, sigmas = [], [], []
        for keyframe in keyframes:
            known = keyframe.frame.features
            camera = known.points_camera(keyframe.frame.frame.intrinsics)
            odom = camera @ keyframe.pose.rotation().matrix().T + keyframe.pose.translation()
            pairs = self._pairs(known, odom, frame, guess)
            pairs = pairs.where(known.depth_m[pairs.first] > 0.0)
            points.append(odom[pairs.first])
            pixels.append(frame.features.pixels[pairs.second].astype(np.float64))
            sigma_px = np.hypot(known.sigma_px[pairs.first], frame.features.sigma_px[pairs.second])
            sigmas.append(sigma_px / np.sqrt(2.0))
        return Landmarks(np.concatenate(points), np.concatenate(pixels), np.concatenate(sigmas))

    def _pairs(
        self, known: Features, points_odom: FloatArray, frame: PreparedFrame, guess: gtsam.Pose3 | None
    ) -> Matches:
        """Return matched features of a keyframe and the frame."""
        config = self._config
        now = frame.features
        if guess is None:
            return match_features(known.descriptors, now.descriptors, config.match_ratio)
        k = frame.frame.intrinsics
        expected = project(points_odom, guess.inverse(), k)
        expected[known.depth_m <= 0.0] = np.nan
        radius_px = config.guided_radius * k.width
        return match_near(known, expected, now, radius_px, config.match_ratio)

    def _align(
        self,
        frame: PreparedFrame,
        local: list[VisualKeyframe],
        landmarks: Landmarks,
        guess: gtsam.Pose3,
        coarse: int,
        slack: float = 1.0,
    ) -> JointAlignment:
        """Solve least squares from one guess; the first steps have a wide kernel."""
        views = [View(keyframe.frame.surface, keyframe.pose) for keyframe in local]
        # A walker shifts surfaces by less than the noise of a bad camera, but not of a good one.
        noise = min(1.0, float(np.median([keyframe.noise for keyframe in local] or 1.0)))
        rounds, k = (coarse, self._match.iterations - coarse), frame.frame.intrinsics
        return align(frame.points, views, landmarks, k, guess, self._config, rounds, slack, noise)

    def _share(self, alignment: JointAlignment) -> float:
        """Return the share of inliers among readings with a partner."""
        # A feature is rarer and more informative than a surface point.
        points = self._config.correlated_points / self._config.correlated_features
        agree = points * alignment.feature_count + alignment.point_count
        total = points * alignment.feature_pairs + alignment.point_pairs
        return agree / total if total > 0.0 else 0.0

    def _judge(self, alignment: JointAlignment) -> VisualMatch | None:
        """Return a measured motion, or None if too little agrees."""
        config = self._config
        share = self._share(alignment)
        shape = alignment.overlap >= self._least_overlap and alignment.point_count >= config.least_points
        enough = shape or alignment.feature_count >= config.least_inliers
        if share < self._match.least_inlier_share or not enough:
            return None
        covariance, weak = covariance_of(alignment.information, share, self._match)
        motion = MotionEstimate(
            T_reference_base=alignment.pose,
            covariance=covariance,
            inlier_share=share,
            fit=share,
            residual_m=alignment.residual_m,
            converged=alignment.converged,
            degenerate=bool(weak.any()),
            weak_direction=weak,
        )
        return VisualMatch(motion, alignment.overlap, alignment.feature_count, alignment.residual_px)


def project(points: FloatArray, T_camera_points: gtsam.Pose3, k: CameraIntrinsics) -> FloatArray:
    """Return pixels (N, 2) of points (N, 3), Yang2021 Eq. (13); NaN behind the camera."""
    camera = points @ T_camera_points.rotation().matrix().T + T_camera_points.translation()
    z = np.where(camera[:, 2] > 0.0, camera[:, 2], np.nan)
    return np.stack([k.fx * camera[:, 0] / z + k.cx, k.fy * camera[:, 1] / z + k.cy], axis=1)
