"""Consistency of covariances with the errors: normalised estimation error squared (NEES), and coverage.

Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", Sec. 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import spatial

from fusion.estimation import gate
from slam.errors import EvaluationError
from slam.estimates import Trajectory
from slam.evaluation.alignment import nearest_indices
from slam.measurements import FloatArray

Indices: TypeAlias = NDArray[np.intp]
_SHARE = 0.95
# Below this angle, the series above has full precision.
_SMALLEST = 1e-4


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often the ground truth is inside the ellipses of the covariances.

    Attributes
    ----------
    held_at_s
        Stamp of the pose at which the trajectory is aligned with the ground truth.
    nees
        Mean squared Mahalanobis distance per degree of freedom: 1 if covariances are as large as errors.
    position, yaw
        Share of the poses whose 95 % ellipse of the position, or interval of the yaw, contains the truth.
    """

    count: int
    held_at_s: float
    nees: float
    position: float
    yaw: float


def coverage(
    trajectory: Trajectory, covariances: FloatArray, reference: Trajectory, max_difference_s: float
) -> Coverage:
    """Compare N poses and their covariances with the ground truth.

    Covariances are relative to a fixed pose. An alignment over all poses would remove much of the error that
    they describe. So the trajectory is aligned with the ground truth at one pose: the one with the smallest
    covariance, which is the fixed one.

    Parameters
    ----------
    covariances
        (N, 3, 3) or (N, 6, 6), see `slam.Map.covariances`.
    max_difference_s
        Largest time between a pose and a ground truth pose; the ground truth is interpolated.

    Raises
    ------
    EvaluationError
        If fewer than two poses have a ground truth, or a covariance is not positive definite.
    """
    truth, covered = truth_at(reference, trajectory.stamps_s, max_difference_s)
    estimate, covariances = trajectory[covered], covariances[covered]
    if len(estimate) < 2:
        raise EvaluationError(f"{len(estimate)} poses have a true one within {max_difference_s} s")
    fixed = int(np.trace(covariances, axis1=1, axis2=2).argmin())
    errors = _errors(estimate, truth, fixed)
    planar = covariances.shape[1] == 3
    errors = errors[:, [0, 1, 5]] if planar else errors
    others = np.arange(len(estimate)) != fixed
    errors, covariances = errors[others], covariances[others]
    axes = 2 if planar else 3
    return Coverage(
        count=len(errors),
        held_at_s=float(estimate.stamps_s[fixed]),
        nees=float(np.mean(_squares(errors, covariances)) / errors.shape[1]),
        position=_within(errors[:, :axes], covariances[:, :axes, :axes]),
        yaw=_within(errors[:, -1:], covariances[:, -1:, -1:]),
    )


def _within(errors: FloatArray, covariances: FloatArray) -> float:
    """Return the share of errors (N, k) inside their ellipses (N, k, k)."""
    return float(np.mean(_squares(errors, covariances) <= gate(errors.shape[1], _SHARE)))


def _squares(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return (N,) squared Mahalanobis distances."""
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(covariances), errors[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        raise EvaluationError("a covariance is not positive definite; write the trajectory anew") from error
    return np.asarray(np.sum(whitened**2, axis=1))


def _errors(estimate: Trajectory, truth: Trajectory, fixed: int) -> FloatArray:
    """Return (N, 6) position and rotation vector, along the map's axes, from poses to their ground truth.

    In exponential coordinates, rotating a path about one of its points gives errors on a straight line (Long,
    Wolfe, Mashner, Chirikjian 2012, "The banana distribution is Gaussian").
    """
    own, true = (spatial.transform.Rotation.from_quat(path.quaternions_xyzw) for path in (estimate, truth))
    turn = own[fixed] * true[fixed].inv()
    shifted = turn.apply(truth.positions_m - truth.positions_m[fixed]) + estimate.positions_m[fixed]
    angles = (turn * true * own.inv()).as_rotvec()
    across = np.cross(angles, shifted - estimate.positions_m)
    half = np.maximum(0.5 * np.linalg.norm(angles, axis=1), _SMALLEST)[:, None]
    # The inverse of the left Jacobian of SO(3).
    curvature = np.cross(angles, across) * (1.0 - half / np.tan(half)) / (2.0 * half) ** 2
    return np.hstack([shifted - estimate.positions_m - 0.5 * across + curvature, angles])


def truth_at(reference: Trajectory, stamps_s: FloatArray, limit_s: float) -> tuple[Trajectory, Indices]:
    """Return the ground truth at those of (N,) stamps where it is known, and their indices."""
    covered = np.flatnonzero(
        np.abs(reference.stamps_s[nearest_indices(reference.stamps_s, stamps_s)] - stamps_s) <= limit_s
    )
    unique_s, order = np.unique(reference.stamps_s, return_index=True)
    truth, truth_s = reference[order], np.clip(stamps_s[covered], unique_s[0], unique_s[-1])
    if len(unique_s) < 2 or not covered.size:
        return truth[np.zeros(len(covered), np.int64)], covered
    quaternions = spatial.transform.Slerp(
        unique_s, spatial.transform.Rotation.from_quat(truth.quaternions_xyzw)
    )(truth_s)
    positions = [np.interp(truth_s, unique_s, axis) for axis in truth.positions_m.T]
    return Trajectory(truth_s, np.column_stack(positions), quaternions.as_quat()), covered
