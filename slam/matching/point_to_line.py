"""Gauss-Newton alignment of a scan to a surfel map with the point-to-line distance.

The metric is that of Censi 2008 (PL-ICP); surfels replace the reference lines, and a Geman-McClure kernel
replaces his trimming.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fusion.estimation import SETTLED, TINY
from fusion.kernel import kernel
from slam.matching.surfel_map import SurfelMap, nearest_surfel
from slam.measurements import AnyFloatArray, FloatArray


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
        (3, 3) covariance of the gradient at the pose, see `slam.matching.score_spread`; None if not
        requested.
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
    """Align a scan so that its points are on the surfels.

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
    pose, hessian = start.astype(np.float64), np.empty((3, 3))
    how = kernel_m, iterations, (SETTLED, SETTLED), prior, np.empty((0, 5))
    sums = align_into(points, normals, guess, *surfel_map, *how, pose, hessian)
    return alignment_of(pose, hessian, sums, len(points))


def alignment_of(
    pose: FloatArray,
    hessian: FloatArray,
    sums: tuple[float, float, float, bool],
    count: int,
    spread: FloatArray | None = None,
) -> Alignment:
    """Return the result of `align_into` for so many points."""
    weight, squares, inliers, converged = sums
    residual_m = math.sqrt(squares / weight) if weight > 0.0 else math.inf
    count = max(count, 1)
    return Alignment(pose, hessian, weight, residual_m, weight / count, inliers / count, converged, spread)


def terms_at(
    points: AnyFloatArray, normals: AnyFloatArray, pose: FloatArray, surfel_map: SurfelMap, kernel_m: float
) -> FloatArray:
    """Return terms (M, 5) of oriented points (M, 2) in an alignment at a pose (3,); zero without a surfel.

    The gradient of its robust cost, tangent order x, y, theta of the base frame; its robust weight; and the
    second derivative of its cost by the residual.
    """
    terms = np.zeros((points.shape[0], 5))
    square = np.zeros((3, 3))
    how = kernel_m, 0, (SETTLED, SETTLED), square, terms
    align_into(points, normals, pose, *surfel_map, *how, pose, square)
    return terms


@kernel(error_model="numpy")
def align_into(  # type: ignore[no-untyped-def]
    points,
    normals,
    guess,
    cells,
    after,
    surfels,
    origin_x,
    origin_y,
    cell_m,
    kernel_m,
    iterations,
    settled,
    prior,
    terms,
    pose,
    hessian,
):
    """Refine ``pose`` (3,) by Gauss-Newton steps; without iterations, only write its ``terms`` (M, 5).

    Writes the Hessian (3, 3) too. Returns the sum of the weights, that of the weighted squares, the inliers
    and whether it has converged.

    One kernel for both, and numbers instead of small arrays: either halves the time to compile.
    """
    px, py, yaw = pose[0], pose[1], pose[2]
    p00, p01, p02 = prior[0, 0], prior[0, 1], prior[0, 2]
    p11, p12, p22 = prior[1, 1], prior[1, 2], prior[2, 2]
    h00 = h01 = h02 = h11 = h12 = h22 = weight = squares = inliers = 0.0
    converged = False
    for _ in range(max(iterations, 1)):
        cos = math.cos(yaw)
        sin = math.sin(yaw)
        g0 = g1 = g2 = h00 = h01 = h02 = h11 = h12 = h22 = weight = squares = inliers = 0.0
        for i in range(points.shape[0]):
            bx = points[i, 0]
            by = points[i, 1]
            x = cos * bx - sin * by + px
            y = sin * bx + cos * by + py
            nx = cos * normals[i, 0] - sin * normals[i, 1]
            ny = sin * normals[i, 0] + cos * normals[i, 1]
            k = nearest_surfel(cells, after, surfels, origin_x, origin_y, cell_m, x, y, nx, ny)
            if k < 0:
                continue
            mx = surfels[k, 2]
            my = surfels[k, 3]
            residual = mx * (x - surfels[k, 0]) + my * (y - surfels[k, 1])
            u = residual / kernel_m
            bowl = 1.0 + u * u
            w = 1.0 / (bowl * bowl)
            j0 = mx * cos + my * sin
            j1 = my * cos - mx * sin
            j2 = j1 * bx - j0 * by
            if iterations == 0:
                weighted = residual / (bowl * bowl)
                terms[i, 0] = weighted * j0
                terms[i, 1] = weighted * j1
                terms[i, 2] = weighted * j2
                terms[i, 3] = w
                terms[i, 4] = (1.0 - 3.0 * (u * u)) / (bowl * bowl * bowl)
            if abs(residual) < 2.0 * kernel_m:
                inliers += 1.0
            w0 = w * j0
            w1 = w * j1
            w2 = w * j2
            g0 += w0 * residual
            g1 += w1 * residual
            g2 += w2 * residual
            h00 += w0 * j0
            h01 += w0 * j1
            h02 += w0 * j2
            h11 += w1 * j1
            h12 += w1 * j2
            h22 += w2 * j2
            weight += w
            squares += w * residual * residual
        if iterations == 0:
            return weight, squares, inliers, converged
        dx = px - guess[0]
        dy = py - guess[1]
        ahead = cos * dx + sin * dy
        left = cos * dy - sin * dx
        turned = yaw - guess[2]
        g0 = g0 + p00 * ahead + p01 * left + p02 * turned
        g1 = g1 + p01 * ahead + p11 * left + p12 * turned
        g2 = g2 + p02 * ahead + p12 * left + p22 * turned
        # Cholesky; LAPACK compiles ten times longer.
        l00 = math.sqrt(max(h00 + p00 + TINY, TINY))
        l10 = (h01 + p01) / l00
        l20 = (h02 + p02) / l00
        l11 = math.sqrt(max(h11 + p11 + TINY - l10 * l10, TINY))
        l21 = (h12 + p12 - l20 * l10) / l11
        l22 = math.sqrt(max(h22 + p22 + TINY - l20 * l20 - l21 * l21, TINY))
        s0 = g0 / l00
        s1 = (g1 - l10 * s0) / l11
        s2 = (g2 - l20 * s0 - l21 * s1) / l22 / l22
        s1 = (s1 - l21 * s2) / l11
        s0 = (s0 - l10 * s1 - l20 * s2) / l00
        px -= cos * s0 - sin * s1
        py -= sin * s0 + cos * s1
        yaw -= s2
        if math.hypot(s0, s1) < settled[0] and abs(s2) < settled[1]:
            converged = True
            break
    pose[0], pose[1], pose[2] = px, py, yaw
    hessian[0, 0], hessian[1, 1], hessian[2, 2] = h00, h11, h22
    hessian[0, 1] = hessian[1, 0] = h01
    hessian[0, 2] = hessian[2, 0] = h02
    hessian[1, 2] = hessian[2, 1] = h12
    return weight, squares, inliers, converged
