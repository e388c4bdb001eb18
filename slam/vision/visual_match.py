"""Match of a frame to keyframes, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import gtsam
import numpy as np

from slam.config.stages import MatchConfig
from slam.estimates import MotionEstimate
from slam.measurements import FloatArray

if TYPE_CHECKING:
    from slam.vision.prepared_frame import PreparedFrame


@dataclass(slots=True)
class VisualKeyframe:
    """A frame of the local map, its ``T_odom_camera``, and measured over configured noise of depth."""

    frame: PreparedFrame
    pose: gtsam.Pose3
    noise: float = 1.0


@dataclass(frozen=True, slots=True)
class VisualMatch:
    """A frame matched to keyframes.

    Attributes
    ----------
    motion
        ``T_odom_camera`` with its covariance, camera frame, GTSAM's order.
    overlap
        Share of the image seen by the keyframes, 0..1.
    residual_px
        Robust sigma of their reprojection.
    """

    motion: MotionEstimate
    overlap: float
    feature_count: int
    residual_px: float

    @property
    def pose(self) -> gtsam.Pose3:
        """Return ``T_odom_camera``."""
        return cast(gtsam.Pose3, self.motion.T_reference_base)


def covariance_of(
    information: FloatArray, inlier_share: float, config: MatchConfig
) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (6, 6) of an alignment and its weak direction (6,), zero if all are determined.

    A translation is degenerate if its sigma exceeds a fifth of the sigma added to a weak axis.
    """
    eigenvalues, eigenvectors = np.linalg.eigh(information)
    least = 1.0 / config.degenerate_sigma_m**2
    covariance = (eigenvectors / np.maximum(eigenvalues, least)) @ eigenvectors.T
    # Readings without a fit reduce the trust in all others.
    covariance /= max(inlier_share, 0.1) ** 2
    # An image is taken at once, a scan during a revolution: its error limit is half that of a scan.
    floor = 0.25 * np.repeat([config.floor_rad**2, config.floor_m**2], 3)
    covariance = 0.5 * (covariance + covariance.T) + np.diag(floor)
    variances, axes = np.linalg.eigh(covariance[3:, 3:])
    weak = np.zeros(6)
    if variances[-1] > (config.degenerate_sigma_m / 5) ** 2:
        weak[3:] = axes[:, -1]
        covariance += config.degenerate_sigma_m**2 * np.outer(weak, weak)
    return covariance, weak


def dissimilarity(pose: gtsam.Pose3, other: gtsam.Pose3, depth_m: float) -> float:
    """Return the difference of two views: translation in scene depths plus rotation in radians."""
    step = pose.between(other)
    travel = float(np.linalg.norm(step.translation())) / depth_m
    return math.hypot(travel, float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation()))))
