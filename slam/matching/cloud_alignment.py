"""Point-to-plane alignment of a cloud in 3D, with its covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from fusion.estimation import SETTLED, TINY, gate, median_to_sigma
from slam.config import Config
from slam.estimates import MotionEstimate
from slam.matching.match_covariance import LEAST_EIGENVALUE
from slam.matching.plane_voxels import PlaneVoxels
from slam.measurements import FloatArray

_LEAST_KERNEL_M, _LEAST_ARM_M = 0.02, 1e-3
# A point within this share of the widest kernel of its plane is on it.
_ON_PLANE = 0.2
# A coarse step below this share of the reach ends the iteration.
_ARRIVED = 0.004


@dataclass(frozen=True, slots=True)
class CloudAlignment:
    """Result of an alignment.

    Attributes
    ----------
    pose
        ``T_map_base``.
    hessian
        (6, 6) of the weighted squared distances, GTSAM's tangent of the base.
    spread
        (6, 6) covariance of its gradient from the residuals: points of one plane share their errors.
    weight
        Sum of the robust weights.
    arms_m
        (3, 3) of the points, see `arms_of`.
    pair_count
        Points on known planes.
    overlap
        Their share of all points.
    inlier_share
        Share of them that agree.
    fit
        Their mean weight.
    residual_m
        Root mean square distance of those that agree.
    agreement
        Share of all points that lie on a plane, by a measure that is the same for every pose of a scan.
    roughness
        Mean square thickness of their planes over that of the thickest plain one, at least 1.
    """

    pose: gtsam.Pose3
    hessian: FloatArray
    spread: FloatArray
    weight: float
    arms_m: FloatArray
    pair_count: int
    overlap: float
    inlier_share: float
    fit: float
    residual_m: float
    converged: bool
    agreement: float
    roughness: float


@dataclass(frozen=True, slots=True)
class PlacedCloud:
    """Where a cloud fits, without its uncertainty; see `CloudAlignment`."""

    pose: gtsam.Pose3
    linear: _Linear
    converged: bool
    agreement: float


def place_cloud(
    points: FloatArray, planes: PlaneVoxels, guess: gtsam.Pose3, iterations: int, kernel_m: float
) -> PlacedCloud | None:
    """Gauss-Newton on the distances to planes, with Cauchy weights whose scale is that of the residuals.

    Parameters and result are those of `align_cloud`.
    """
    pose, converged, last_at = guess, False, np.full((2, len(points)), -1)
    for _ in range(iterations):
        linear = _linearise(points, planes, pose, kernel_m, last_at)
        if linear is None:
            return None
        step = _step(linear.hessian, linear.gradient)
        pose = pose.compose(gtsam.Pose3.Expmap(step))
        # The remaining gain is less than a hundredth of a point: only noise.
        if -(linear.gradient @ step) < LEAST_EIGENVALUE * linear.kernel_m**2 or np.abs(step).max() < SETTLED:
            converged = True
            break
    linear = _linearise(points, planes, pose, kernel_m, last_at)
    if linear is None:
        return None
    return PlacedCloud(pose, linear, converged, share_on_planes(linear.residuals, kernel_m, len(points)))


def align_cloud(
    points: FloatArray, planes: PlaneVoxels, guess: gtsam.Pose3, iterations: int, kernel_m: float
) -> CloudAlignment | None:
    """Find where a cloud fits, as `place_cloud` does, and how well.

    Parameters
    ----------
    points
        (N, 3) base frame.
    guess
        ``T_map_base``.
    kernel_m
        The widest kernel; a point farther than that from its plane never agrees.

    Returns
    -------
    None if fewer than six points lie on planes.
    """
    placed = place_cloud(points, planes, guess, iterations, kernel_m)
    if placed is None:
        return None
    linear = placed.linear
    agree = np.abs(linear.residuals) <= linear.kernel_m
    inliers = linear.residuals[agree]
    return CloudAlignment(
        placed.pose,
        linear.hessian,
        linear.spread(),
        float(linear.weights.sum()),
        arms_of(points),
        len(linear.residuals),
        len(linear.residuals) / len(points),
        float(agree.mean()),
        float(linear.weights.mean()),
        float(np.sqrt(np.mean(inliers**2))) if len(inliers) else np.inf,
        placed.converged,
        placed.agreement,
        planes.roughness(linear.planes),
    )


def drawn_near(
    points: FloatArray, planes: PlaneVoxels, guess: gtsam.Pose3, iterations: int, reach_m: float
) -> gtsam.Pose3:
    """Roughly align points (N, 3), base frame, from ``T_map_base``, to the centres of large voxels.

    Planes hold a pose at the first match; centres of voxels pull along streets and through walls. A plane
    with a wide kernel then aligns the rest.
    """
    pose = guess
    for _ in range(iterations):
        hessian, gradient = planes.pulls(points, pose.matrix(), reach_m)
        step = _step(hessian, gradient)
        pose = pose.compose(gtsam.Pose3.Expmap(step))
        if np.linalg.norm(step[3:]) < _ARRIVED * reach_m:
            break
    placed = place_cloud(points, planes, pose, iterations, reach_m)
    return pose if placed is None else placed.pose


def share_on_planes(residuals: FloatArray, kernel_m: float, point_count: int) -> float:
    """Return the share of points near their planes; 0 if fewer than six have one. See `CloudAlignment`."""
    count = np.count_nonzero(np.abs(residuals) <= _ON_PLANE * kernel_m)
    return count / point_count if len(residuals) >= 6 else 0.0


def arms_of(points: FloatArray) -> FloatArray:
    """Return (3, 3) for points (N, 3): a small rotation w moves them by ``|arms @ w|``, root mean square.

    The root of their inertia: about the axis of a street points have short arms, about the vertical long.
    """
    spread = points.T @ points / max(len(points), 1)
    squares, axes = np.linalg.eigh(np.trace(spread) * np.eye(3) - spread)
    return np.asarray(axes * np.sqrt(np.maximum(squares, _LEAST_ARM_M**2)) @ axes.T)


def levers(arms_m: FloatArray) -> FloatArray:
    """Return (6, 6) that converts a twist, GTSAM's tangent, to the motion of points, metres."""
    scaling = np.eye(6)
    scaling[:3, :3] = arms_m
    return scaling


def motion_of(alignment: CloudAlignment, config: Config, guess: gtsam.Pose3) -> MotionEstimate:
    """Wrap an alignment as a measured motion with its covariance.

    The covariance is H^-1 S H^-1 with the spread S of the gradient, in which the points of a plane share
    their errors as much as the residuals show (Liang and Zeger 1986). It is at least s^2 H^-1 with as many
    readings as ``correlated_points`` make of the points (Censi 2007 shows when that is right).

    A direction that the cloud does not determine keeps its value of the guess (solution remapping, Zhang
    2016) and gets ``degenerate_sigma_m`` squared on top.
    """
    lever = levers(alignment.arms_m)
    turns = np.linalg.inv(lever)
    values, vectors = np.linalg.eigh(turns @ alignment.hessian @ turns)
    squares = np.sum(np.square(vectors[3:]), axis=0)
    weak = vectors[:, values < 0.5 * config.match.degenerate_share * max(alignment.weight, 1.0) * squares]
    least_m = config.match.minimal_residual_m
    scale = max(alignment.residual_m, least_m) if np.isfinite(alignment.residual_m) else 1.0
    # Points without a fit reduce the trust in all others, and noise along rays tilts all rough planes.
    doubt = alignment.roughness / max(alignment.inlier_share, 0.1) ** 2
    root = turns @ vectors / np.sqrt(np.maximum(values, LEAST_EIGENVALUE))
    # Ratio of the spread to that of independent residuals, by direction.
    shared, directions = np.linalg.eigh(root.T @ alignment.spread @ root / scale**2)
    widened = root @ directions * np.sqrt(np.maximum(shared, config.cloud_odometry.correlated_points))
    # An edge ends at two keyframes, and the one that it starts from was itself matched as well as this one.
    covariance = 2.0 * doubt * scale**2 * (widened @ widened.T)
    covariance += config.match.floor_m**2 * (turns @ turns)  # a rotation by the motion of the points
    pose, weakest = alignment.pose, np.zeros(6)
    if weak.shape[1]:
        shift = lever @ gtsam.Pose3.Logmap(pose.between(guess))
        pose = pose.compose(gtsam.Pose3.Expmap(turns @ weak @ (weak.T @ shift)))
        open_ = turns @ weak
        covariance += config.match.degenerate_sigma_m**2 * (open_ @ open_.T)
        weakest = open_[:, 0] / np.linalg.norm(open_[:, 0])
    return MotionEstimate(
        T_reference_base=pose,
        covariance=covariance,
        inlier_share=alignment.inlier_share,
        fit=alignment.fit,
        residual_m=alignment.residual_m,
        converged=alignment.converged,
        degenerate=bool(weak.shape[1]),
        weak_direction=weakest,
    )


@dataclass(frozen=True, slots=True)
class _Linear:
    """The linear least squares at a pose."""

    hessian: FloatArray
    gradient: FloatArray
    residuals: FloatArray
    weights: FloatArray
    kernel_m: float
    gradients: FloatArray
    planes: NDArray[np.int64]

    def spread(self) -> FloatArray:
        """(6, 6) of the gradient: those of one plane's points are added up before they are squared."""
        order = np.argsort(self.planes, kind="stable")
        planes = self.planes[order]
        starts = np.flatnonzero(np.concatenate([[True], planes[1:] != planes[:-1]]))
        sums = np.add.reduceat(self.gradients[order], starts)
        return np.asarray(sums.T @ sums)


def _step(hessian: FloatArray, gradient: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step, (6,)."""
    damping = np.diag(np.maximum(np.diag(hessian), LEAST_EIGENVALUE)) * TINY
    return np.asarray(-np.linalg.solve(hessian + damping, gradient))


def _linearise(
    points: FloatArray, planes: PlaneVoxels, pose: gtsam.Pose3, kernel_m: float, last_at: NDArray[np.int64]
) -> _Linear | None:
    """Return Hessian and gradient for a motion of the base in its own frame."""
    T_map_base = pose.matrix()
    pairs = planes.residuals(points, T_map_base, last_at)
    residuals = pairs.distances_m
    if len(residuals) < 6:
        return None
    spread = median_to_sigma() * float(np.median(np.abs(residuals)))
    kernel_m = float(np.clip(math.sqrt(gate()) * spread, _LEAST_KERNEL_M, kernel_m))
    weights, gradients, sums = planes.normal_equations(points, T_map_base, pairs, kernel_m)
    return _Linear(sums[:6], sums[6], residuals, weights, kernel_m, gradients, pairs.voxels)
