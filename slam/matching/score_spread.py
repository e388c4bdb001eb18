"""How far the residuals of an alignment scatter its gradient, neighbours' common errors included.

Beams that see the same piece of wall share that piece's error in the map, so they are not independent
readings. How much they share differs from log to log and from room to room, and the residuals tell it: the
covariance of the gradient is summed up over neighbouring beams too (Newey and West 1987, Bartlett weights).
"""

from __future__ import annotations

import numpy as np

from fusion.kernel import kernel
from slam.matching.point_to_line import terms_at
from slam.matching.surfel_map import SurfelMap
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
    terms = terms_at(points, normals, pose, surfel_map, kernel_m)
    half, weight, bend = _half_spread(terms, lags)
    flattened = weight / max(bend, _LEAST_BEND * weight) if weight > 0.0 else 1.0
    spread = np.array(half).reshape(3, 3)
    return (spread + spread.T) * flattened**2


@kernel
def _half_spread(terms, lags):  # type: ignore[no-untyped-def]
    """Newey and West 1987: products of neighbours, weighted down with their distance.

    A matrix row by row, to which its transpose is to be added; and the sums of weight and bend.
    """
    weight = bend = xx = xy = xt = yx = yy = yt = tx = ty = tt = 0.0
    for i in range(terms.shape[0]):
        x = terms[i, 0]
        y = terms[i, 1]
        turn = terms[i, 2]
        # Half the own product: the transpose counts it once more.
        sum_x = 0.5 * x
        sum_y = 0.5 * y
        sum_t = 0.5 * turn
        for lag in range(1, lags + 1):
            if i + lag >= terms.shape[0]:
                break
            share = 1.0 - lag / (lags + 1.0)
            sum_x += share * terms[i + lag, 0]
            sum_y += share * terms[i + lag, 1]
            sum_t += share * terms[i + lag, 2]
        xx += x * sum_x
        xy += x * sum_y
        xt += x * sum_t
        yx += y * sum_x
        yy += y * sum_y
        yt += y * sum_t
        tx += turn * sum_x
        ty += turn * sum_y
        tt += turn * sum_t
        weight += terms[i, 3]
        bend += terms[i, 4]
    return (xx, xy, xt, yx, yy, yt, tx, ty, tt), weight, bend
