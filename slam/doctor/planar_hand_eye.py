"""Pose of a sensor with motion in 3D on a robot with motion in the plane, from the motions of both.

A rotation of the robot is a rotation of the sensor about the robot's vertical axis (hand-eye calibration,
Tsai 1989); perpendicular to that axis, its translations relate to the robot's as those of a 2D lidar.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fusion.estimation import FEWEST, SETTLED, gate
from slam.doctor.pair import IN_ORDER
from slam.doctor.relation import fit_linear, relate
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
    if len(base) < FEWEST or float(np.std(base[:, 2])) < IN_ORDER:
        return None
    number = np.arange(float(len(base)))
    design = (base[:, 2, None, None] * np.eye(3)).reshape(-1, 3)
    turning = fit_linear(design, turns.ravel(), np.repeat(number, 3))
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
    seen, wheels = (
        np.ascontiguousarray(xy).view(np.complex128)[:, 0] for xy in (shifts_m @ axes.T, base[:, :2])
    )
    moving = relate(seen, base[:, 2], wheels, number)
    if moving is None or gate() * moving.sigma_alpha**2 > 1.0:
        return None
    scale, lever = abs(moving.alpha), moving.beta / moving.alpha
    sigma_scale = moving.sigma_alpha * scale
    lever_sigmas = np.hypot(np.sqrt(np.diag(moving.covariance)[2:]) / scale, abs(lever) * moving.sigma_alpha)
    left = np.abs(moving.alpha * wheels + moving.beta * (np.exp(1j * base[:, 2]) - 1.0) - seen)
    ahead = (moving.alpha.real * axes[0] + moving.alpha.imag * axes[1]) / scale
    tilt = math.sqrt(max(0.0, float(np.trace(slope_cov) - up @ slope_cov @ up))) / gain
    gain_sigma = math.sqrt(float(up @ slope_cov @ up))
    sigmas = np.array([gain_sigma, sigma_scale, moving.sigma_alpha, *lever_sigmas])
    spread = float(np.median(left) / max(np.median(np.abs(seen)), SETTLED))
    agree = int(np.count_nonzero(left**2 < gate(2) * moving.sigma_m**2))
    place_m = np.array([lever.real, lever.imag])
    return PlanarHandEye(up, ahead, scale, place_m, sigmas, tilt, spread, agree)
