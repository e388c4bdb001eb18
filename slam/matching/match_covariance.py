"""How far a scan match can be trusted: covariance and degeneracy from its own Hessian."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import TINY
from slam.config.stages import MatchConfig
from slam.matching.point_to_line import Alignment
from slam.measurements import FloatArray, MotionEstimate, pose2_from_row

# In points: no direction is infinitely uncertain.
LEAST_EIGENVALUE = 0.01
# Sigma of a direction that is not determined: no information, and a covariance still.
OPEN_M = 30.0


def motion_from_alignment(alignment: Alignment, noise: MatchConfig) -> MotionEstimate:
    """Wrap an alignment as a measured motion with its covariance.

    The covariance is H^-1 S H^-1 with the spread S of the gradient, in which neighbouring beams share their
    errors as much as the residuals show (Newey and West 1987). With independent residuals that is s^2 H^-1
    (Censi 2007 shows when this is right). Of a direction that the scan does not determine nothing is said: it
    gets a variance beside which that of whatever else measures it counts alone.
    """
    weak = weak_direction(alignment, noise.degenerate_share)
    scale = (
        max(alignment.residual_m, noise.minimal_residual_m) if math.isfinite(alignment.residual_m) else 1.0
    )
    # Points that fit nothing are a doubt about all the others.
    doubt = 1.0 / max(alignment.inlier_share, 0.1) ** 2
    # An edge ends at two keyframes, and the one that it starts from was itself matched as well as this one.
    covariance = 2.0 * doubt * scale**2 * _correlated_inverse(alignment)
    covariance += np.diag([noise.floor_m**2, noise.floor_m**2, noise.floor_rad**2])
    if weak is not None:
        covariance += OPEN_M**2 * np.outer(weak, weak)
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
    # Less than one point's worth determines nothing.
    least = degenerate_share * max(alignment.weight, 1.0)
    xx, xy, xt, _, yy, yt, _, _, tt = (alignment.hessian + TINY * np.eye(3)).ravel().tolist()
    xx, xy, yy = xx - xt * xt / tt, xy - xt * yt / tt, yy - yt * yt / tt
    lower = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
    # Clearly determined, as nearly always: rounding leaves no doubt of that.
    if lower - TINY * (xx + yy) > least:
        return None
    eigenvalues, eigenvectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    if eigenvalues[0] >= least:
        return None
    return np.array([eigenvectors[0, 0], eigenvectors[1, 0], 0.0])


def _correlated_inverse(alignment: Alignment) -> FloatArray:
    """Covariance (3, 3) for a residual of 1: H^-1, widened by what the residuals share.

    Eigenvalues of the Hessian are held above a hundredth of a point: no direction is infinitely uncertain.
    Residuals that seem to share less than nothing do so by chance.
    """
    shared, axes = _shared(alignment)
    widened = axes * np.sqrt(shared)
    return np.asarray(widened @ widened.T, dtype=np.float64)


def points_a_witness(alignment: Alignment) -> float:
    """How many neighbouring points share their errors, as the residuals show: 1 where all are independent."""
    return float(_shared(alignment)[0].mean())


def _shared(alignment: Alignment) -> tuple[FloatArray, FloatArray]:
    """By how much what residuals share widens H^-1, (3,), and the axes along which it does, (3, 3)."""
    eigenvalues, eigenvectors = np.linalg.eigh(alignment.hessian)
    root = eigenvectors / np.sqrt(np.maximum(eigenvalues, LEAST_EIGENVALUE))
    if alignment.spread is None or not 0.0 < alignment.residual_m < np.inf:
        return np.ones(3), root
    whitened = root.T @ alignment.spread @ root / alignment.residual_m**2
    shared, directions = np.linalg.eigh(whitened)
    return np.maximum(shared, 1.0), root @ directions
