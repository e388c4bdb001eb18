"""Pose from matched features without initial guess: PnP-RANSAC by three points (Ke2017), then least squares.

The squares are those of Yang2021 Eq. (3)-(6).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import gtsam
import numpy as np

from fusion.estimation import CONFIDENCE, ROUNDS
from slam.config.stages import RgbdOdometryConfig
from slam.measurements import BoolArray, CameraIntrinsics, FloatArray
from slam.vision.features import Features, match_features


@dataclass(frozen=True, slots=True)
class FeaturePose:
    """A pose supported by many features.

    Attributes
    ----------
    T_reference_camera
        Of the new image, in the frame of the 3D points.
    inliers
        (N,) which pairs are inliers.
    """

    T_reference_camera: gtsam.Pose3
    inliers: BoolArray


def pose_from_features(
    points_reference: FloatArray,
    pixels: FloatArray,
    intrinsics: CameraIntrinsics,
    tolerance_px: float,
    least_inliers: int,
) -> FeaturePose | None:
    """Estimate the pose of a camera from known points and their pixels; None with too few inliers.

    Parameters
    ----------
    points_reference
        (N, 3).
    pixels
        (N, 2) in the new image.
    tolerance_px
        Largest reprojection error of an inlier.
    """
    if len(points_reference) < max(least_inliers, 4):
        return None
    import cv2

    k = intrinsics
    camera = np.array([[k.fx, 0.0, k.cx], [0.0, k.fy, k.cy], [0.0, 0.0, 1.0]])
    points = np.ascontiguousarray(points_reference, np.float64)
    observed = np.ascontiguousarray(pixels, np.float64)
    solved, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        observed,
        camera,
        None,
        reprojectionError=tolerance_px,
        confidence=CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not solved or inliers is None:
        return None
    mask = np.zeros(len(points), bool)
    mask[inliers[:, 0]] = True
    # The pose from three points is inexact: that from all has more inliers.
    for _ in range(2):
        if np.count_nonzero(mask) < least_inliers:
            return None
        rotation, translation = cv2.solvePnPRefineLM(
            points[mask], observed[mask], camera, np.zeros(0), rotation, translation
        )
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all()):
            return None
        expected = cv2.projectPoints(points, rotation, translation, camera, None)[0][:, 0]
        mask = np.linalg.norm(expected - observed, axis=1) <= tolerance_px
    if np.count_nonzero(mask) < least_inliers:
        return None
    T_camera_reference = gtsam.Pose3(gtsam.Rot3.Expmap(rotation.ravel()), translation.ravel())
    return FeaturePose(T_camera_reference.inverse(), mask)


def turn_from_features(
    before: Features, after: Features, intrinsics: CameraIntrinsics, config: RgbdOdometryConfig
) -> gtsam.Rot3:
    """Estimate the rotation of a camera between two images without translation; no depth is needed.

    The identity with fewer than ``config.least_inliers`` inliers.
    """
    import scipy

    pairs = match_features(before.descriptors, after.descriptors, config.match_ratio)
    if len(pairs) < config.least_inliers:
        return gtsam.Rot3()
    first = _rays(before, intrinsics)[pairs.first]
    second = _rays(after, intrinsics)[pairs.second]
    tolerance = config.kernel_sigmas / intrinsics.fx
    residuals, weights = np.zeros(len(pairs)), np.ones(len(pairs))
    turn = scipy.spatial.transform.Rotation.identity()
    for _ in range(ROUNDS):
        turn = scipy.spatial.transform.Rotation.align_vectors(first, second, weights)[0]
        residuals = np.linalg.norm(turn.apply(second) - first, axis=1)
        # The tolerance is the median error, down to the accuracy of a keypoint.
        weights = 1.0 / (1.0 + (residuals / max(float(np.median(residuals)), tolerance)) ** 2) ** 2
    if np.count_nonzero(residuals <= tolerance) < config.least_inliers:
        return gtsam.Rot3()
    return gtsam.Rot3(turn.as_matrix())


def _rays(features: Features, intrinsics: CameraIntrinsics) -> FloatArray:
    """Return unit directions (N, 3) of features."""
    points = replace(features, depth_m=np.ones_like(features.depth_m)).points_camera(intrinsics)
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
