"""SE(2) arithmetic on rows of x, y, yaw, for kernels where GTSAM objects would be too slow."""

from __future__ import annotations

import math

import numpy as np

from slam.measurements import AnyFloatArray, FloatArray


def compose(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return T_a * T_b for two rows (3,)."""
    x, y, yaw = a.tolist()
    bx, by, b_yaw = b.tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([x + cos * bx - sin * by, y + sin * bx + cos * by, wrap(yaw + b_yaw)])


def between(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return inverse(T_a) * T_b for two rows (3,)."""
    x, y, yaw = a.tolist()
    bx, by, b_yaw = b.tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    dx, dy = bx - x, by - y
    return np.array([cos * dx + sin * dy, -sin * dx + cos * dy, wrap(b_yaw - yaw)])


def wrap(angle_rad: float) -> float:
    """Return the same angle in [-pi, pi)."""
    return angle_rad - math.tau * math.floor((angle_rad + math.pi) / math.tau)


def transform_points(points: AnyFloatArray, pose: FloatArray) -> FloatArray:
    """Return (M, 2) points transformed by a pose row (3,), float64."""
    tx, ty, yaw = np.asarray(pose, np.float64).tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    x, y = np.asarray(points, np.float64).T
    return np.column_stack([cos * x - sin * y + tx, sin * x + cos * y + ty])


def adjoint(pose: FloatArray) -> FloatArray:
    """Return the SE(2) adjoint (3, 3), GTSAM's order (x, y, theta): covariance_a = Ad covariance_b Ad^T."""
    x, y, yaw = pose.tolist()
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([[cos, -sin, y], [sin, cos, -x], [0.0, 0.0, 1.0]])


def rotate_covariance(adjoint_a_b: FloatArray, covariance_b: FloatArray) -> FloatArray:
    """Return Ad covariance Ad^T, (3, 3): a covariance of the tangent space of b in that of a."""
    return adjoint_a_b @ covariance_b @ adjoint_a_b.T
