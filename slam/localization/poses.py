"""Poses with their covariance, in the plane and in 3D."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np

from slam.measurements import FloatArray, Pose, composed, logarithm, motion_between

# Poses nearer than this are one place, metres and radians: an alignment from either finds the same.
SAME_M, SAME_RAD = 0.3, 0.15


class Measured(NamedTuple):
    """A pose or motion with its covariance (d, d), GTSAM's order, in the frame after it."""

    pose: Pose
    covariance: FloatArray


def after(known: Measured, step: Measured) -> Measured:
    """Return a pose after a motion."""
    adjoint = step.pose.inverse().AdjointMap()
    covariance = adjoint @ known.covariance @ adjoint.T + step.covariance
    return Measured(composed(known.pose, step.pose), covariance)


def separation(one: Pose, other: Pose) -> tuple[float, float]:
    """Return metres and radians between two poses."""
    step = motion_between(one, other)
    if isinstance(step, gtsam.Pose2):
        return float(np.hypot(step.x(), step.y())), abs(step.theta())
    turned_rad = float(np.linalg.norm(gtsam.Rot3.Logmap(step.rotation())))
    return float(np.linalg.norm(step.translation())), turned_rad


def position_sigma_m(known: Measured) -> float:
    """Return the largest standard deviation of a position."""
    planar = isinstance(known.pose, gtsam.Pose2)
    position = known.covariance[:2, :2] if planar else known.covariance[3:, 3:]
    return math.sqrt(float(np.linalg.eigvalsh(position)[-1]))


def mixture(origin: Pose, poses: Sequence[Measured], weights: FloatArray) -> Measured:
    """Return mean and covariance of near poses of which one is true, with probabilities (n,)."""
    apart_ = np.array([logarithm(motion_between(origin, item.pose)) for item in poses])
    mean = weights @ apart_
    scatter = (weights[:, None] * (apart_ - mean)).T @ (apart_ - mean)
    covariance = scatter + np.tensordot(weights, [item.covariance for item in poses], 1)
    planar = isinstance(origin, gtsam.Pose2)
    step = gtsam.Pose2.Expmap(mean) if planar else gtsam.Pose3.Expmap(mean)
    return Measured(composed(origin, step), covariance)


def same_place(one: Pose, other: Pose) -> bool:
    """Return whether two poses are the same place."""
    apart_m, turned_rad = separation(one, other)
    return apart_m < SAME_M and turned_rad < SAME_RAD


def as_place(pose: Pose) -> Measured:
    """Return a pose with three sigmas as large as one place."""
    return Measured(pose, diagonal(pose, SAME_M / 3.0, SAME_RAD / 3.0))


def squared_mahalanobis(expected: Measured, measured: Measured) -> float:
    """Return the squared Mahalanobis distance of a measured and an expected pose, by both covariances."""
    offset = logarithm(motion_between(expected.pose, measured.pose))
    return float(offset @ np.linalg.solve(expected.covariance + measured.covariance, offset))


def diagonal(like: Pose, sigma_m: float, sigma_rad: float) -> FloatArray:
    """Return the (d, d) covariance of a pose as ``like``, from one sigma of positions and one of angles."""
    metres, radians = sigma_m**2, sigma_rad**2
    if isinstance(like, gtsam.Pose2):
        return np.diag([metres, metres, radians])
    return np.diag([radians] * 3 + [metres] * 3)
