"""Gauss-Newton alignment of a scan to a surfel map with the point-to-line distance.

The metric is Censi 2008 (PL-ICP); the surfels play the part of the reference lines, and a Geman-McClure
kernel takes the part of his trimming.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusion.kernel import kernel
from slam.matching.surfel_map import SurfelMap, nearest_surfel
from slam.measurements import AnyFloatArray, FloatArray

_SETTLED_M = 1e-4
_SETTLED_RAD = 1e-4
_REGULARISATION = 1e-6


class Alignment(NamedTuple):
    """The result of one alignment.

    Attributes
    ----------
    pose
        (3,) x, y, yaw of the scan's base frame in the map's frame.
    hessian
        (3, 3) sum of w J^T J, in points, tangent order x, y, theta of the base frame.
    weight
        Sum of the robust weights: how many points carry the result.
    residual_m
        Robustly weighted root mean square of the point-to-line distances.
    fit
        Mean robust weight over all points with a normal, 0..1.
    inlier_share
        Points within twice the kernel width over all points with a normal, 0..1.
    converged
        Whether the last step was below a tenth of a millimetre and of a milliradian.
    spread
        (3, 3) covariance of the gradient at the pose, see `slam.matching.score_spread`; None where nobody
        asked for it.
    """

    pose: FloatArray
    hessian: FloatArray
    weight: float
    residual_m: float
    fit: float
    inlier_share: float
    converged: bool
    spread: FloatArray | None = None


def align(
    points: AnyFloatArray,
    normals: AnyFloatArray,
    start: FloatArray,
    guess: FloatArray,
    surfel_map: SurfelMap,
    kernel_m: float,
    iterations: int,
    prior: FloatArray,
) -> Alignment:
    """Move a scan so that its points lie on the surfels.

    Parameters
    ----------
    points, normals
        (M, 2), base frame, every point with its normal.
    start
        (3,) x, y, yaw of the base in the map where the iteration starts.
    guess
        (3,) where the prior holds the pose.
    surfel_map
        What to align to; a point finds surfels up to 1.5 cells away.
    kernel_m
        Width of the Geman-McClure kernel.
    iterations
        Limit of the Gauss-Newton steps.
    prior
        (3, 3) information that holds the pose at the guess, tangent order x, y, theta of the base frame,
        in units of points.
    """
    pose, hessian, weight, squares, inliers, converged = _align(
        points, normals, start, guess, surfel_map, kernel_m, iterations, prior
    )
    residual_m = math.sqrt(squares / weight) if weight > 0.0 else math.inf
    count = max(len(points), 1)
    return Alignment(pose, hessian, weight, residual_m, weight / count, inliers / count, converged)


@kernel
def _align(  # type: ignore[no-untyped-def]
    points, normals, start, guess, surfel_map: SurfelMap, kernel_m: float, iterations: int, prior
):
    pose = start.copy()
    hessian = np.zeros((3, 3))
    damped = np.zeros((3, 3))
    weight = 0.0
    squares = 0.0
    inliers = 0
    converged = False
    for _ in range(iterations):
        hessian, gradient, weight, squares, inliers = _linearise(points, normals, pose, surfel_map, kernel_m)
        cos = math.cos(pose[2])
        sin = math.sin(pose[2])
        dx = pose[0] - guess[0]
        dy = pose[1] - guess[1]
        offset = (cos * dx + sin * dy, -sin * dx + cos * dy, pose[2] - guess[2])
        for row in range(3):
            for column in range(3):
                gradient[row] += prior[row, column] * offset[column]
                damped[row, column] = hessian[row, column] + prior[row, column]
        step = _solve(damped, gradient)
        pose[0] -= cos * step[0] - sin * step[1]
        pose[1] -= sin * step[0] + cos * step[1]
        pose[2] -= step[2]
        if math.hypot(step[0], step[1]) < _SETTLED_M and abs(step[2]) < _SETTLED_RAD:
            converged = True
            break
    return pose, hessian, weight, squares, inliers, converged


@kernel
def _solve(matrix, right):  # type: ignore[no-untyped-def]
    """Solution of a symmetric positive 3 x 3 system by Cholesky; LAPACK compiles ten times longer."""
    lower = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            rest = matrix[i, j] + (_REGULARISATION if i == j else 0.0)
            for k in range(j):
                rest -= lower[i, k] * lower[j, k]
            lower[i, j] = math.sqrt(max(rest, _REGULARISATION)) if i == j else rest / lower[j, j]
    solution = right.copy()
    for i in range(3):
        for k in range(i):
            solution[i] -= lower[i, k] * solution[k]
        solution[i] /= lower[i, i]
    for i in range(2, -1, -1):
        for k in range(i + 1, 3):
            solution[i] -= lower[k, i] * solution[k]
        solution[i] /= lower[i, i]
    return solution


@kernel
def _linearise(points, normals, pose, surfel_map: SurfelMap, kernel_m: float):  # type: ignore[no-untyped-def]
    """Normal equations at a pose; the tangent moves the base frame on its own right side."""
    surfels = surfel_map.surfels
    hessian = np.zeros((3, 3))
    gradient = np.zeros(3)
    weight = 0.0
    squares = 0.0
    inliers = 0
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
    jacobian = np.empty(3)
    for i in range(points.shape[0]):
        px = points[i, 0]
        py = points[i, 1]
        x = cos * px - sin * py + pose[0]
        y = sin * px + cos * py + pose[1]
        nx = cos * normals[i, 0] - sin * normals[i, 1]
        ny = sin * normals[i, 0] + cos * normals[i, 1]
        k = nearest_surfel(surfel_map, x, y, nx, ny)
        if k < 0:
            continue
        mx = surfels[k, 2]
        my = surfels[k, 3]
        residual = mx * (x - surfels[k, 0]) + my * (y - surfels[k, 1])
        w = 1.0 / (1.0 + (residual / kernel_m) ** 2) ** 2
        if abs(residual) < 2.0 * kernel_m:
            inliers += 1
        jacobian[0] = mx * cos + my * sin
        jacobian[1] = -mx * sin + my * cos
        jacobian[2] = -jacobian[0] * py + jacobian[1] * px
        for a in range(3):
            gradient[a] += w * jacobian[a] * residual
            for b in range(a, 3):
                hessian[a, b] += w * jacobian[a] * jacobian[b]
        weight += w
        squares += w * residual * residual
    hessian[1, 0] = hessian[0, 1]
    hessian[2, 0] = hessian[0, 2]
    hessian[2, 1] = hessian[1, 2]
    return hessian, gradient, weight, squares, inliers
