"""How far the residuals of an alignment scatter its gradient, neighbours' common errors included.

Beams that see the same piece of wall share that piece's error in the map, so they are not independent
readings. How much they share differs from log to log and from room to room, and the residuals tell it: the
covariance of the gradient is summed up over neighbouring beams too (Newey and West 1987, Bartlett weights).
"""

from __future__ import annotations

import math

import numpy as np

from fusion.kernel import kernel
from slam.matching.surfel_map import SurfelMap, nearest_surfel
from slam.measurements import AnyFloatArray, FloatArray

# Where hardly a residual is within the bend, the kernel's second derivative is no measure.
_LEAST_BEND = 0.2


def score_spread(
    points: AnyFloatArray,
    normals: AnyFloatArray,
    pose: FloatArray,
    surfel_map: SurfelMap,
    kernel_m: float,
    lags: int,
) -> FloatArray:
    """Covariance (3, 3) of the gradient of an alignment, tangent order x, y, theta of the base frame.

    Parameters
    ----------
    points, normals
        (M, 2), base frame, in beam order.
    pose
        (3,) where the alignment ended.
    kernel_m
        Width of its Geman-McClure kernel.
    lags
        Beams up to this far apart may share their errors.

    Returns
    -------
    In square metres times points: what small independent residuals of variance s^2 give is s^2 times the
    Hessian of Gauss and Newton. Larger residuals are beyond the bend of the kernel; the Hessian takes its
    weights for its second derivative, and the spread makes up for that.
    """
    gradients, weight, bend = _gradients(points, normals, pose, surfel_map, kernel_m)
    flattened = weight / max(bend, _LEAST_BEND * weight) if weight > 0.0 else 1.0
    return _spread(gradients, lags) * flattened**2


@kernel
def _gradients(points, normals, pose, surfel_map: SurfelMap, kernel_m: float):  # type: ignore[no-untyped-def]
    """(M, 3) gradients of the points' robust costs, zero without a surfel; sums of weight and bend."""
    surfels = surfel_map.surfels
    gradients = np.zeros((points.shape[0], 3))
    weight = 0.0
    bend = 0.0
    cos = math.cos(pose[2])
    sin = math.sin(pose[2])
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
        u = (residual / kernel_m) ** 2
        weighted = residual / (1.0 + u) ** 2
        weight += 1.0 / (1.0 + u) ** 2
        bend += (1.0 - 3.0 * u) / (1.0 + u) ** 3
        along = mx * cos + my * sin
        across = -mx * sin + my * cos
        gradients[i, 0] = weighted * along
        gradients[i, 1] = weighted * across
        gradients[i, 2] = weighted * (across * px - along * py)
    return gradients, weight, bend


@kernel
def _spread(gradients, lags: int):  # type: ignore[no-untyped-def]
    """Newey and West 1987: products of neighbours, weighted down with their distance."""
    spread = np.zeros((3, 3))
    for i in range(gradients.shape[0]):
        # Half the own product, so that adding the transpose below counts it once.
        sums = 0.5 * gradients[i]
        for lag in range(1, min(lags, gradients.shape[0] - 1 - i) + 1):
            sums += (1.0 - lag / (lags + 1.0)) * gradients[i + lag]
        for a in range(3):
            for b in range(3):
                spread[a, b] += gradients[i, a] * sums[b]
    return spread + spread.T
