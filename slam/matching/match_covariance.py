"""How far a scan match can be trusted: covariance and degeneracy from its own Hessian."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from slam.matching.point_to_line import Alignment
from slam.measurements import FloatArray, MotionEstimate, pose2_from_row


@dataclass(frozen=True, slots=True)
class MatchNoise:
    """What turns a Hessian into a covariance.

    Attributes
    ----------
    correlated_points
        Neighbouring beams see the same wall through the same map error: this many count as one reading.
    floor_m, floor_rad
        Standard deviations that no match falls below (timing, quantisation, discretisation).
    degenerate_share
        A translation direction is degenerate where its information, after the rotation is taken out,
        is below this share of the information of all points together.
    degenerate_sigma_m
        Standard deviation given to a degenerate direction.
    minimal_residual_m
        Range resolution of the sensors: a smaller residual is luck.
    """

    correlated_points: float
    floor_m: float
    floor_rad: float
    degenerate_share: float
    degenerate_sigma_m: float
    minimal_residual_m: float


def motion_from_alignment(alignment: Alignment, noise: MatchNoise) -> MotionEstimate:
    """Wrap an alignment as a measured motion with its covariance.

    The covariance is s^2 H^-1 (Censi 2007 shows when this is right) with the residual scale s, inflated for
    correlation; a direction that the scan does not determine gets ``degenerate_sigma_m`` squared on top.
    """
    weak = weak_direction(alignment, noise.degenerate_share)
    scale = max(alignment.residual_m, noise.minimal_residual_m) if np.isfinite(alignment.residual_m) else 1.0
    # Points that fit nothing are a doubt about all the others.
    doubt = 1.0 / max(alignment.inlier_share, 0.1) ** 2
    covariance = doubt * scale**2 * noise.correlated_points * _inverse_clamped(alignment.hessian)
    covariance += np.diag([noise.floor_m**2, noise.floor_m**2, noise.floor_rad**2])
    if weak is not None:
        covariance += noise.degenerate_sigma_m**2 * np.outer(weak, weak)
    return MotionEstimate(
        T_reference_base=pose2_from_row(alignment.pose),
        covariance=covariance,
        inlier_share=alignment.inlier_share,
        fit=alignment.fit,
        residual_m=alignment.residual_m,
        converged=alignment.converged,
        degenerate=weak is not None,
        weak_direction=np.zeros(3) if weak is None else weak,
    )


def weak_direction(alignment: Alignment, degenerate_share: float) -> FloatArray | None:
    """Unit tangent (3,) of the translation that a match does not determine; None where all is determined.

    The rotation is eliminated first (Schur complement): what counts is the information on a direction when
    the yaw is free. It is compared with the number of points, so it does not depend on the beam count.
    """
    information = alignment.hessian + np.eye(3) * 1e-9
    translation = information[:2, :2] - np.outer(information[:2, 2], information[:2, 2]) / information[2, 2]
    eigenvalues, eigenvectors = np.linalg.eigh(translation)
    # Less than one point's worth determines nothing.
    if eigenvalues[0] >= degenerate_share * max(alignment.weight, 1.0):
        return None
    return np.array([eigenvectors[0, 0], eigenvectors[1, 0], 0.0])


def _inverse_clamped(information: FloatArray) -> FloatArray:
    """Inverse with eigenvalues held above a hundredth of a point: no direction is infinitely uncertain."""
    eigenvalues, eigenvectors = np.linalg.eigh(information)
    inverse: FloatArray = (eigenvectors / np.maximum(eigenvalues, 0.01)) @ eigenvectors.T
    return inverse
