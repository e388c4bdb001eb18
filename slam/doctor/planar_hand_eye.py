"""Pose of a sensor with motion in 3D on a robot with motion in the plane, from the motions of both.

A rotation of the robot is a rotation of the sensor about the robot's vertical axis; perpendicular to that
axis, the sensor's translations are the robot's, rotated, scaled, plus the lever arm: linear in four numbers
(hand-eye calibration, Tsai 1989).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from slam.doctor.relation import Linear, fit_linear
from slam.measurements import FloatArray


@dataclass(frozen=True, slots=True)
class PlanarHandEye:
    """Estimates about a sensor from paired motions.

    Attributes
    ----------
    up
        (3,) the robot's vertical axis in the sensor's frame, unit length.
    ahead
        (3,) the robot's forward axis in that frame.
    scale
        Ratio of the sensor's translations to the robot's.
    lever_m
        (2,) position of the sensor on the robot, x and y, in the robot's metres.
    sigmas
        (5,) standard deviations of the rotation gain, scale, the angle of ``ahead`` (radians), the lever arm.
    tilt_sigma_rad
        Standard deviation of ``up``, radians.
    spread
        Robust residual of the fit as a share of the sensor's translations.
    count
        Number of pairs that agree.
    """

    up: FloatArray
    ahead: FloatArray
    scale: float
    lever_m: FloatArray
    sigmas: FloatArray
    tilt_sigma_rad: float
    spread: float
    count: int


def planar_hand_eye(turns: FloatArray, shifts_m: FloatArray, base: FloatArray) -> PlanarHandEye | None:
    """Fit the pose, the rotation gain and the scale of translations.

    Parameters
    ----------
    turns, shifts_m
        (N, 3) rotation vectors and translations of the sensor's steps, in its frame at the start of each.
    base
        (N, 3) x, y and rotation of the robot's steps, in its frame at the start of each.

    Returns
    -------
    None if the motions do not determine it: too few, without rotations, or without translations.
    """
    if len(base) < FEWEST:
        return None
    turning = _fit(base[:, 2, None, None] * np.eye(3), turns)
    if turning is None:
        return None
    slopes, slope_cov = turning.values, turning.covariance
    gain = float(np.linalg.norm(slopes))
    if gain < gate() ** 0.5 * math.sqrt(float(np.trace(slope_cov))):
        return None
    up = slopes / gain
    # Two axes perpendicular to the vertical, from the less vertical one of the optical and the right axis.
    first = np.eye(3)[int(np.argmin(np.abs(up)))]
    first = first - (first @ up) * up
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(up, first)])
    cos, sin = np.cos(base[:, 2]) - 1.0, np.sin(base[:, 2])
    x, y = base[:, 0], base[:, 1]
    # p = M t + (R - 1) M l, M = [[a, -b], [b, a]]; unknown are a, b and M l.
    design = np.stack([np.stack([x, -y, cos, -sin], axis=1), np.stack([y, x, sin, cos], axis=1)], axis=1)
    moving = _fit(design, shifts_m @ axes.T)
    if moving is None:
        return None
    found, covariance = moving.values, moving.covariance
    a, b = found[:2]
    scale = math.hypot(a, b)
    sigma_ab = math.sqrt(max(covariance[0, 0], covariance[1, 1]))
    if scale < gate() ** 0.5 * sigma_ab:
        return None
    turned = np.array([[a, -b], [b, a]])
    lever = np.linalg.solve(turned, found[2:])
    lever_sigmas = np.sqrt(np.diag(covariance)[2:] + (np.linalg.norm(lever) * sigma_ab) ** 2) / scale
    left = np.linalg.norm(np.einsum("nij,j->ni", design, found) - shifts_m @ axes.T, axis=1)
    moved = np.linalg.norm(shifts_m @ axes.T, axis=1)
    ahead = (a * axes[0] + b * axes[1]) / scale
    tilt = math.sqrt(max(0.0, float(np.trace(slope_cov) - up @ slope_cov @ up))) / gain
    gain_sigma = math.sqrt(float(up @ slope_cov @ up))
    sigmas = np.array([gain_sigma, sigma_ab, sigma_ab / scale, *lever_sigmas])
    spread = float(np.median(left) / max(np.median(moved), SETTLED))
    agree = int(np.count_nonzero(left**2 < gate(2) * moving.sigma**2))
    return PlanarHandEye(up, ahead, scale, lever, sigmas, tilt, spread, agree)


def _fit(design: FloatArray, seen: FloatArray) -> Linear | None:
    """Fit (N, d, k) to (N, d)."""
    number = np.repeat(np.arange(float(len(seen))), seen.shape[1])
    return fit_linear(design.reshape(-1, design.shape[2]), seen.ravel(), number)
