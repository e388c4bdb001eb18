"""Align a frame to keyframes: surfaces by point-to-plane and features by reprojection, together.

Either part may be empty: texture determines the pose at a bare wall, shape in a dark room.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np

from fusion.estimation import FEWEST, SETTLED, TINY, median_to_sigma
from slam.config.stages import RgbdOdometryConfig
from slam.measurements import AnyFloatArray, CameraIntrinsics, FloatArray
from slam.vision.alignment_kernels import feature_part, room_for_points, surface_part
from slam.vision.surface import Surface, SurfacePoints

_THINNED = 4


class View(NamedTuple):
    """A keyframe's surface and the pose of its camera, ``T_odom_camera``."""

    surface: Surface
    pose: gtsam.Pose3


class Landmarks(NamedTuple):
    """Matched features: (L, 3) points, odometry frame, (L, 2) pixels in the new image, (L,) their sigma."""

    points: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray

    @classmethod
    def none(cls) -> Landmarks:
        """Return no features."""
        return cls(np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0))


@dataclass(frozen=True, slots=True)
class JointAlignment:
    """Result of an alignment.

    Attributes
    ----------
    pose
        ``T_odom_camera``.
    information
        (6, 6) of the pose, GTSAM's order, camera frame, by the measured residuals and correlations.
    overlap
        Share of the points that meet a keyframe's surface.
    point_pairs, feature_pairs
        Points with a partner surface, and matched features.
    residual_m
        Robust sigma of point to plane of the inliers.
    residual_px
        Robust sigma of the reprojection of the inliers.
    converged
        Whether the last step was small.
    """

    pose: gtsam.Pose3
    information: FloatArray
    overlap: float
    point_pairs: int
    feature_pairs: int
    point_count: int
    feature_count: int
    residual_m: float
    residual_px: float
    converged: bool


def align(
    points: SurfacePoints,
    views: list[View],
    landmarks: Landmarks,
    intrinsics: CameraIntrinsics,
    guess: gtsam.Pose3,
    config: RgbdOdometryConfig,
    rounds: tuple[int, int],
    slack: float = 1.0,
    noise: float = 1.0,
) -> JointAlignment:
    """Find ``T_odom_camera`` of a frame near a guess.

    Parameters
    ----------
    points
        The frame's surface points, camera frame.
    views
        Keyframes that may see the same.
    landmarks
        Features of the keyframes found again in the frame.
    intrinsics
        Of the pixels in ``landmarks``.
    rounds
        Largest number of Gauss-Newton steps, first with four times the tolerance, then with the final.
    slack
        Final tolerance as a share of the configured one.
    noise
        Sigma of depth as a share of the configured one.
    """
    # A few points give a rough pose; all are used for the last millimetres.
    coarse = _Work(points.every(_THINNED), landmarks, noise)
    start, _ = _descend(coarse, views, intrinsics, guess, config, rounds[0], 10 * SETTLED, 4.0)
    fine = _Work(points, landmarks, noise)
    pose, step = _descend(fine, views, intrinsics, start, config, rounds[1], SETTLED, slack)
    fine.linearize(views, intrinsics, pose, config, 1.0, informed=True)
    return fine.conclude(pose, config, converged=step < 10 * SETTLED)


def _descend(
    work: _Work,
    views: list[View],
    intrinsics: CameraIntrinsics,
    pose: gtsam.Pose3,
    config: RgbdOdometryConfig,
    rounds: int,
    settled: float,
    slack: float,
) -> tuple[gtsam.Pose3, float]:
    """Iterate Gauss-Newton until a step is shorter than ``settled``; return pose and last step length."""
    length = np.inf
    for _ in range(rounds):
        hessian, gradient = work.linearize(views, intrinsics, pose, config, slack)
        ridge = TINY * float(np.trace(hessian))
        if ridge <= 0.0:
            return pose, np.inf
        # In an undetermined direction, as along a bare wall, the pose does not move.
        step = np.linalg.solve(hessian + ridge * np.eye(6), gradient)
        length = float(np.linalg.norm(step))
        if length > 1.0:
            return pose, np.inf
        pose = pose.compose(gtsam.Pose3.Expmap(step))
        if length < settled:
            break
    return pose, length


class _Work:
    """Residuals and information of both parts at one linearisation, stored to be judged after the last."""

    def __init__(self, points: SurfacePoints, landmarks: Landmarks, noise: float) -> None:
        self.points, self.landmarks, self.noise, self.room = points, landmarks, noise, room_for_points()
        self.point_residuals = np.full(len(points), np.inf, np.float32)
        self.seen = np.zeros(len(points), np.float32)
        self.feature_residuals = np.full(len(landmarks.points), np.inf)
        self.information = np.zeros((6, 6)), np.zeros((6, 6))

    def linearize(
        self,
        views: list[View],
        k: CameraIntrinsics,
        pose: gtsam.Pose3,
        config: RgbdOdometryConfig,
        slack: float,
        *,
        informed: bool = False,
    ) -> tuple[FloatArray, FloatArray]:
        """Return the normal equations (6, 6), (6,) of both parts, weighted by their correlations.

        If ``informed``, the information of the surfaces replaces theirs.
        """
        self.seen[:] = 0.0
        self.point_residuals[:] = np.inf
        sums = np.zeros((6, 7))
        gate_m, kernel = config.gate_m * slack, config.kernel_sigmas * slack
        sigma = self.noise * config.depth_floor_m, self.noise * config.depth_share
        limits = np.array([gate_m, kernel, *sigma], np.float32)
        for surface, view_pose in views:
            c = surface.intrinsics
            surface_part(
                self.points.rows,
                view_pose.between(pose).matrix().astype(np.float32),
                surface.planes.reshape(-1, 4),
                np.array([c.fx, c.fy, c.cx, c.cy, c.width, c.height], np.float32),
                limits,
                *self.room,
                sums,
                self.seen,
                self.point_residuals,
                informed,
            )
        depth_h, depth_g = sums[:, :6], -sums[:, 6]
        feature_h, feature_g = np.zeros((6, 6)), np.zeros(6)
        feature_part(
            self.landmarks.points,
            self.landmarks.pixels,
            self.landmarks.sigma_px,
            pose.inverse().matrix(),
            *(k.fx, k.fy, k.cx, k.cy),
            kernel,
            np.zeros((2, 6)),
            feature_h,
            feature_g,
            self.feature_residuals,
        )
        self.information = (0.5 * (depth_h + depth_h.T), feature_h)
        hessian = depth_h / config.correlated_points + feature_h / config.correlated_features
        gradient = depth_g / config.correlated_points + feature_g / config.correlated_features
        return hessian, gradient

    def conclude(self, pose: gtsam.Pose3, config: RgbdOdometryConfig, *, converged: bool) -> JointAlignment:
        """Judge the residuals of the last linearisation at this pose."""
        is_seen = self.seen > 0.0
        agreeing = self.point_residuals[self.point_residuals < config.kernel_sigmas]
        matched = self.feature_residuals[self.feature_residuals < config.kernel_sigmas]
        point_scale = _robust_scale(self.noise * agreeing, 1)
        feature_scale = _robust_scale(matched, 2)
        information = self.information[0] / (config.correlated_points * (point_scale / self.noise) ** 2)
        information += self.information[1] / (config.correlated_features * feature_scale**2)
        depth = np.median(self.points.points[:, 2]) if len(self.points) else 1.0
        sigma_m = config.depth_floor_m + config.depth_share * depth**2
        return JointAlignment(
            pose=pose,
            information=information,
            overlap=float(is_seen.mean()) if is_seen.size else 0.0,
            point_pairs=int(is_seen.sum()),
            feature_pairs=int(self.feature_residuals.size),
            point_count=int(agreeing.size),
            feature_count=int(matched.size),
            residual_m=float(point_scale * sigma_m),
            residual_px=float(feature_scale * np.median(self.landmarks.sigma_px)) if matched.size else 0.0,
            converged=converged,
        )


def _robust_scale(residuals: AnyFloatArray, degrees: int) -> float:
    """Return the robust sigma of normalised residuals; 1 if there are too few."""
    if residuals.size < FEWEST:
        return 1.0
    return max(float(median_to_sigma(degrees) * np.median(residuals)), 0.05)
