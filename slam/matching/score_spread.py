"""Scatter of an alignment's gradient from its residuals, including correlated errors of neighbouring beams.

Beams that see the same piece of wall share the error of that piece in the map, so they are not independent.
How much they share differs between logs and rooms, and the residuals show it: the covariance of the gradient
is also summed over neighbouring beams (Newey and West 1987, Bartlett weights).
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
    terms, spread = terms_at(points, normals, pose, surfel_map, kernel_m), np.empty((3, 3))
    spread_of(terms, lags, np.empty((len(terms) + 1, 3)), spread)
    return spread


@kernel(error_model="numpy")
def spread_of(terms, lags, sums, spread):  # type: ignore[no-untyped-def]
    """Write the spread (3, 3) of terms (M, 5), see `slam.matching.point_to_line.terms_at`.

    It sums the products of all pairs of gradients up to ``lags`` apart, by weights that fall with the lag.
    Bartlett's weight of a pair, 1 - lag / (lags + 1), is the share of the windows of lags + 1 rows which hold
    both: so it is the mean of the products of the windows' sums. ``sums`` (M + 1, 3) is room.
    """
    count = terms.shape[0]
    weight = curvature = 0.0
    sums[0, 0] = sums[0, 1] = sums[0, 2] = 0.0
    for i in range(count):
        sums[i + 1, 0] = sums[i, 0] + terms[i, 0]
        sums[i + 1, 1] = sums[i, 1] + terms[i, 1]
        sums[i + 1, 2] = sums[i, 2] + terms[i, 2]
        weight += terms[i, 3]
        curvature += terms[i, 4]
    flattened = weight / max(curvature, _LEAST_BEND * weight) if weight > 0.0 else 1.0
    s00 = s01 = s02 = s11 = s12 = s22 = 0.0
    for window in range(count + lags):
        last = min(window + 1, count)
        first = max(window - lags, 0)
        x = sums[last, 0] - sums[first, 0]
        y = sums[last, 1] - sums[first, 1]
        turn = sums[last, 2] - sums[first, 2]
        s00 += x * x
        s01 += x * y
        s02 += x * turn
        s11 += y * y
        s12 += y * turn
        s22 += turn * turn
    scale = flattened * flattened / (lags + 1)
    spread[0, 0] = scale * s00
    spread[0, 1] = spread[1, 0] = scale * s01
    spread[0, 2] = spread[2, 0] = scale * s02
    spread[1, 1] = scale * s11
    spread[1, 2] = spread[2, 1] = scale * s12
    spread[2, 2] = scale * s22
