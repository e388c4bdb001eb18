"""Relation of the steps of wheels and of a lidar: a planar hand-eye calibration.

Censi 2013 ("Simultaneous calibration of odometry and sensor parameters for mobile robots", Sec. V): the
lidar's step l in its own frame, the wheels' step w and the rotation phi satisfy
s w + (R(phi) - 1) t = r R(psi) l. With steps as complex numbers that is linear,

    l = alpha w + beta (exp(i phi) - 1),    alpha = s / r exp(-i psi),    beta = t / r exp(-i psi):

psi is the yaw of the lidar, t its position, s and r are factors for the lengths of wheels and lidar. Other
errors of the wheels (a sign, an axis) give other w; the right one fits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fusion.estimation import FEWEST, ROUNDS, SETTLED, gate, median_to_sigma
from slam.measurements import FloatArray

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, slots=True)
class Linear:
    """A robust linear fit.

    Attributes
    ----------
    values
        (P,) estimates.
    covariance
        (P, P), from the differences between stretches, because steps of one stretch share errors.
    sigma
        Robust standard deviation of a residual.
    """

    values: FloatArray
    covariance: FloatArray
    sigma: float


def fit_linear(design: FloatArray, measured: FloatArray, stretch: FloatArray) -> Linear | None:
    """Fit (N, P) to (N,) with Geman-McClure weights at the scale of the residuals; None for too few.

    ``stretch`` (N,) is the index of the stretch of each.
    """
    if len(measured) < FEWEST or np.linalg.matrix_rank(design) < design.shape[1]:
        return None
    # A step far larger than the others has no more influence at first: it may be a jump of the wheels.
    sizes = np.sum(design**2, axis=1)
    weights = 1.0 / (np.mean(sizes) + sizes)
    sigma = np.inf
    for _ in range(ROUNDS):
        root = np.sqrt(weights)
        values = np.asarray(np.linalg.lstsq(design * root[:, None], measured * root)[0], np.float64)
        residuals = measured - design @ values
        sigma = max(SETTLED, median_to_sigma() * float(np.median(np.abs(residuals))))
        weights = 1.0 / (1.0 + residuals**2 / (sigma**2 * gate())) ** 2
    bread = np.linalg.inv((design * weights[:, None]).T @ design)
    scores = design * (weights * residuals)[:, None]
    _, number = np.unique(stretch, return_inverse=True)
    sums = np.zeros((number.max() + 1, design.shape[1]))
    np.add.at(sums, number, scores)
    meat = sums.T @ sums * len(sums) / max(1, len(sums) - 1)
    # If stretches agree by chance, the residuals limit the certainty.
    floor_of = bread * sigma**2
    covariance = bread @ meat @ bread + floor_of
    return Linear(values, covariance, sigma)


@dataclass(frozen=True, slots=True)
class Relation:
    """The relation of wheels and lidar, see above.

    Attributes
    ----------
    alpha, beta
        As above.
    covariance
        (4, 4) covariance of the real and imaginary parts of alpha, then of beta.
    sigma_m
        Robust standard deviation of a residual along an axis.
    """

    alpha: complex
    beta: complex
    covariance: FloatArray
    sigma_m: float

    @property
    def yaw_rad(self) -> float:
        """Yaw of the lidar on the robot."""
        return float(-np.angle(self.alpha))

    @property
    def sigma_alpha(self) -> float:
        """Relative standard deviation of alpha along an axis; also that of its angle, radians."""
        return float(np.sqrt(0.5 * np.trace(self.covariance[:2, :2])) / abs(self.alpha))

    @property
    def sigma_beta(self) -> float:
        """Standard deviation of beta along its least certain axis."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[2:, 2:])[-1]))

    def mirrored(self) -> Relation:
        """The relation with left and right exchanged in both."""
        signs = np.array([1.0, -1.0, 1.0, -1.0])
        covariance = self.covariance * np.outer(signs, signs)
        return replace(self, alpha=self.alpha.conjugate(), beta=self.beta.conjugate(), covariance=covariance)

    def of_ranges_scaled(self, scale: float) -> Relation:
        """The relation for the ranges before they were multiplied by a scale."""
        covariance = self.covariance / scale**2
        return replace(self, alpha=self.alpha / scale, beta=self.beta / scale, covariance=covariance)

    def with_lever_scaled(self, scale: float) -> Relation:
        """The relation if ranges and wheels are both multiplied by a scale."""
        scales = np.array([1.0, 1.0, scale, scale])
        covariance = self.covariance * np.outer(scales, scales)
        return replace(self, beta=self.beta * scale, covariance=covariance)

    def with_wheels_turned(self, turned: complex) -> Relation:
        """The relation if the wheels' steps are rotated by a complex number of length one."""
        return replace(self, alpha=self.alpha / turned)

    def position(self, range_scale: float = 1.0) -> complex:
        """Position of the lidar, x and y as a complex number."""
        return self.beta * np.exp(1j * self.yaw_rad) * range_scale


def relate(
    lidar: ComplexArray, turns_rad: FloatArray, wheels: ComplexArray, stretch: FloatArray
) -> Relation | None:
    """Fit the relation to (K,) steps; None if there are too few, or no rotations."""
    swing = np.exp(1j * turns_rad) - 1.0
    # Wheels may have any unit, so their steps are scaled to a usual length.
    unit = max(float(np.median(np.abs(wheels))), np.finfo(float).tiny)
    columns = [wheels / unit, 1j * wheels / unit, swing, 1j * swing]
    design = np.column_stack([np.concatenate([column.real, column.imag]) for column in columns])
    lidar_parts = np.concatenate([lidar.real, lidar.imag])
    fitted = fit_linear(design, lidar_parts, np.concatenate([stretch, stretch]))
    if fitted is None:
        return None
    a, b, c, d = fitted.values.tolist()
    scale = np.array([1.0 / unit, 1.0 / unit, 1.0, 1.0])
    covariance = fitted.covariance * np.outer(scale, scale)
    return Relation(complex(a, b) / unit, complex(c, d), covariance, fitted.sigma)
