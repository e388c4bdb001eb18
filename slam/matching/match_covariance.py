"""Covariance and degeneracy of a scan match, from its own Hessian."""

from __future__ import annotations

import math

import numpy as np

from fusion.estimation import ROUNDS, TINY
from fusion.kernel import kernel
from slam.config.stages import MatchConfig
from slam.estimates import MotionEstimate
from slam.matching.point_to_line import Alignment
from slam.measurements import FloatArray, pose2_from_row

# In points: limits the uncertainty of any direction.
LEAST_EIGENVALUE = 0.01
# Sigma of an undetermined direction: practically no information.
OPEN_M = 30.0


def motion_from_alignment(alignment: Alignment, noise: MatchConfig) -> MotionEstimate:
    """Wrap an alignment as a measured motion with its covariance.

    The covariance is H^-1 S H^-1 with the spread S of the gradient, in which neighbouring beams share their
    errors as much as the residuals show (Newey and West 1987). With independent residuals that is s^2 H^-1
    (Censi 2007 shows when this is right). An undetermined direction gets a variance so large that only other
    measurements of it count.
    """
    weak = weak_direction(alignment, noise.degenerate_share)
    scale = (
        max(alignment.residual_m, noise.minimal_residual_m) if math.isfinite(alignment.residual_m) else 1.0
    )
    # Points without a fit reduce the trust in all others.
    doubt = 1.0 / max(alignment.inlier_share, 0.1) ** 2
    # An edge ends at two keyframes, and the one that it starts from was itself matched as well as this one.
    covariance = 2.0 * doubt * scale**2 * _widened(alignment)[0]
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
    """Return the unit tangent (3,) of an undetermined translation; None if all is determined.

    The rotation is eliminated first (Schur complement): what counts is the information on a direction when
    the yaw is free. It is compared with the number of points, so it does not depend on the beam count.
    """
    # Less than the information of one point determines nothing.
    least = degenerate_share * max(alignment.weight, 1.0)
    (xx, xy), (_, yy) = schur(alignment.hessian)
    lower = 0.5 * (xx + yy) - math.hypot(0.5 * (xx - yy), xy)
    # Clearly determined, as nearly always, regardless of rounding.
    if lower - TINY * (xx + yy) > least:
        return None
    eigenvalues, eigenvectors = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    if eigenvalues[0] >= least:
        return None
    return np.array([eigenvectors[0, 0], eigenvectors[1, 0], 0.0])


def schur(hessian: FloatArray) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the rows of a Hessian (3, 3) of the translation when the yaw is free."""
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = hessian.tolist()
    xx, yy, tt = xx + TINY, yy + TINY, tt + TINY
    across = xy - xt * yt / tt
    return (xx - xt * xt / tt, across), (across, yy - yt * yt / tt)


def points_a_witness(alignment: Alignment) -> float:
    """Return how many neighbouring points share their errors, by the residuals: 1 if all are independent."""
    return _widened(alignment)[1]


def _widened(alignment: Alignment) -> tuple[FloatArray, float]:
    """Return H^-1 widened for correlated residuals, (3, 3), at unit variance; and the mean factor.

    Eigenvalues of the Hessian are at least a hundredth of a point: no direction is infinitely uncertain.
    Negatively correlated residuals are so by chance.
    """
    spread, squared = alignment.spread, alignment.residual_m**2
    if spread is None or not 0.0 < squared < math.inf:
        spread, squared = np.zeros((3, 3)), 1.0
    hessian, axes = alignment.hessian.copy(), np.empty((3, 3))
    whitened, directions, covariance = np.empty((3, 3, 3))
    return covariance, _widen(hessian, spread, squared, axes, whitened, directions, covariance)


@kernel(error_model="numpy")
def _widen(hessian, spread, squared, axes, whitened, directions, covariance):  # type: ignore[no-untyped-def]
    """Write the covariance of `_widened`; return the mean factor. All (3, 3)."""
    _diagonalize(hessian, axes)
    for k in range(3):
        root = 1.0 / math.sqrt(max(hessian[k, k], LEAST_EIGENVALUE))
        for i in range(3):
            axes[i, k] *= root
    for a in range(3):
        for b in range(3):
            total = 0.0
            for i in range(3):
                for j in range(3):
                    total += axes[i, a] * spread[i, j] * axes[j, b]
            whitened[a, b] = total / squared
            covariance[a, b] = 0.0
    _diagonalize(whitened, directions)
    mean = 0.0
    for k in range(3):
        shared = max(whitened[k, k], 1.0)
        mean += shared / 3
        for i in range(3):
            total = 0.0
            for j in range(3):
                total += axes[i, j] * directions[j, k]
            hessian[i, k] = total
        for i in range(3):
            for j in range(3):
                covariance[i, j] += shared * hessian[i, k] * hessian[j, k]
    return mean


@kernel
def _diagonalize(matrix, axes):  # type: ignore[no-untyped-def]
    """Diagonalise a symmetric (3, 3) matrix by Jacobi rotations; its axes are columns."""
    for i in range(3):
        for j in range(3):
            axes[i, j] = 1.0 if i == j else 0.0
    for _ in range(ROUNDS):
        off_diagonal = abs(matrix[0, 1]) + abs(matrix[0, 2]) + abs(matrix[1, 2])
        if off_diagonal <= TINY * TINY * (abs(matrix[0, 0]) + abs(matrix[1, 1]) + abs(matrix[2, 2])):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if matrix[p, q] == 0.0:
                    continue
                slant = (matrix[q, q] - matrix[p, p]) / (2.0 * matrix[p, q])
                tan = math.copysign(1.0, slant) / (abs(slant) + math.hypot(slant, 1.0))
                cos = 1.0 / math.hypot(tan, 1.0)
                sin = tan * cos
                for k in range(3):
                    x, y = matrix[k, p], matrix[k, q]
                    matrix[k, p], matrix[k, q] = cos * x - sin * y, sin * x + cos * y
                for k in range(3):
                    x, y = matrix[p, k], matrix[q, k]
                    matrix[p, k], matrix[q, k] = cos * x - sin * y, sin * x + cos * y
                    x, y = axes[k, p], axes[k, q]
                    axes[k, p], axes[k, q] = cos * x - sin * y, sin * x + cos * y
