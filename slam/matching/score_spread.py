"""How far the residuals of an alignment scatter its gradient, neighbours' common errors included.

Beams that see the same piece of wall share that piece's error in the map, so they are not independent
readings. How much they share differs from log to log and from room to room, and the residuals tell it: the
covariance of the gradient is summed up over neighbouring beams too (Newey and West 1987, Bartlett weights).
"""

from __future__ import annotations

import numpy as np

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
    weight, bend = terms[:, 3:].sum(axis=0).tolist()
    flattened = weight / max(bend, _LEAST_BEND * weight) if weight > 0.0 else 1.0
    return _bartlett_sum(terms[:, :3], lags) * flattened**2


def _bartlett_sum(rows: FloatArray, lags: int) -> FloatArray:
    """Sum (3, 3) of the products of all pairs of rows up to so far apart, by weights that fall with the lag.

    Bartlett's weight of a pair, 1 - lag / (lags + 1), is the share of the windows of lags + 1 rows which hold
    both: so it is the mean of the products of the windows' sums.
    """
    sums = np.zeros((len(rows) + 2 * lags + 1, 3))
    within = slice(lags + 1, lags + 1 + len(rows))
    np.cumsum(rows, axis=0, out=sums[within])
    sums[within.stop :] = sums[within.stop - 1]
    windows = sums[lags + 1 :] - sums[: -lags - 1]
    return windows.T @ windows / (lags + 1)
