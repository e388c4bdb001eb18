# mypy: allow-untyped-decorators
"""Probability that a repaired value is right: logistic regression on features measured around it.

``python tools/learn_repair_odds.py`` learns the weights from simulated homes that no figure uses.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.curves import SLACK_M, BoolArray, Float32Array, FloatArray
from fusion.kernel import kernel
from fusion.repair import AVERAGED, FILLED, HOLE, INTERPOLATED, ProvenanceArray

# Rows for beams: the camera fills a hole, a line fills a hole, the camera replaces a reading, a line replaces
# a reading, the mean of both. Rows for pixels: fills a hole, replaces a reading. Replaced readings of beams,
# and the mean, are learned from the simulator's own sensors only.
# fmt: off
BEAM_ODDS = np.array([[ 3.930e+00, -2.260e+00,  1.040e+00, -1.330e+00, -8.800e-01, -6.000e-02,  0.000e+00,
   7.500e-01, -2.600e-01,  1.300e-01,  2.700e-01, -1.310e+00,  0.000e+00, -3.700e-01,
  -6.000e-02,  8.800e-01,  3.600e-01,  0.000e+00,  2.600e-01,  3.600e-01, -9.000e-01,
   0.000e+00, -1.580e+00,  5.600e-01,  0.000e+00,  2.700e-01,  0.000e+00,  0.000e+00],
 [ 5.400e+00, -1.520e+00, -1.210e+00, -1.800e+00,  4.000e-01, -2.910e+00,  0.000e+00,
   3.000e-01,  3.000e-02,  1.100e-01,  2.500e-01, -2.600e-01,  0.000e+00, -5.000e-02,
   4.700e-01, -1.400e-01, -2.800e-01,  0.000e+00,  8.000e-02,  7.000e-02,  7.000e-02,
   0.000e+00, -2.000e-01, -4.100e-01,  0.000e+00,  1.250e+00,  0.000e+00,  0.000e+00],
 [ 3.790e+00,  2.700e-01, -3.700e-01, -3.300e-01, -2.400e+00,  3.500e-01,  4.000e-01,
  -7.000e-02, -7.000e-01, -1.600e-01,  1.160e+00, -5.000e-01,  2.700e-01,  5.800e-01,
   4.000e-01, -5.600e-01,  1.200e-01,  5.000e-02,  4.000e-02, -1.800e-01, -5.400e-01,
   1.000e-02,  1.800e-01,  2.800e-01,  3.100e-01,  2.700e-01, -4.800e-01, -3.200e-01],
 [ 6.850e+00,  8.000e-02, -3.600e-01, -3.730e+00,  1.200e+00, -1.200e-01,  1.820e+00,
   8.000e-02, -1.400e-01,  2.100e-01,  6.000e-02,  8.000e-02, -7.000e-02,  1.900e-01,
   8.800e-01,  1.000e-02, -1.610e+00, -1.490e+00,  1.300e-01, -4.100e-01,  4.400e-01,
   1.370e+00, -6.500e-01,  9.000e-02,  9.600e-01,  3.300e-01, -1.180e+00, -2.140e+00],
 [ 1.163e+01, -3.860e+00, -1.000e-02, -4.610e+00, -1.310e+00, -2.670e+00,  4.800e-01,
   2.600e-01, -4.900e-01,  9.300e-01,  1.010e+00, -4.500e-01, -1.200e-01,  9.200e-01,
  -4.400e-01, -1.390e+00,  7.900e-01, -1.800e-01,  4.700e-01,  7.600e-01,  1.000e-01,
  -3.000e-02,  2.100e-01, -3.400e-01, -1.600e-01,  1.000e+00, -2.600e-01, -1.800e-01]])
PIXEL_ODDS = np.array([[-4.18,  9.15, -2.24,  4.68,  5.25,  0.  , -0.87, -5.41,  1.83,  4.2 , -0.69, -1.89,
   0.04,  1.22, -0.13,  0.08,  0.  ,  0.1 , -0.87, -0.46,  3.32,  0.06,  0.06,  1.27,
   0.43,  1.64,  0.  ,  0.25, -2.91,  2.83,  0.6 , -0.22,  0.23, -0.01, -0.07,  0.  ,
   0.08, -0.89,  0.34,  1.35,  0.11,  0.04, -0.03,  0.  ,  0.06, -1.11,  0.16,  2.16,
  -0.06,  0.27,  0.  ,  0.  ,  0.  ,  0.  ,  0.  ,  0.  ,  0.  ,  0.05,  0.74, -0.71,
   0.45, -0.14,  0.06, -0.43,  2.81, -3.83, -1.75,  0.37, -1.55,  1.21,  0.08,  0.55,
   2.36, -0.78, -0.04,  0.21, -0.17,  0.33],
 [-0.99, -3.76, -1.74, -2.15,  1.28,  4.08,  1.38, -1.13, -0.67,  0.81, -0.78,  0.02,
  -0.24,  2.32,  0.02, -0.1 , -0.01,  0.12,  0.37,  0.27, -0.92,  0.79, -0.02,  1.45,
   1.11,  0.96, -0.23,  1.15, -0.42,  2.34,  4.18, -1.9 ,  3.59,  0.02, -0.2 , -0.25,
   0.16,  0.23, -0.71, -0.25,  0.05,  0.32, -0.55,  0.11,  0.04,  0.66, -0.4 ,  0.59,
   0.39,  0.27,  0.15, -0.05, -2.26,  1.13,  0.15,  0.49, -0.26,  0.29, -1.24,  0.32,
   0.67, -0.7 ,  0.27,  0.82,  2.33, -0.28,  0.81, -0.02, -0.95,  0.57, -0.69,  1.02,
   1.73,  0.61,  0.98,  0.45, -1.01,  0.1 ]])
# fmt: on


def probabilities(kinds: NDArray[np.intp], features: FloatArray, odds: FloatArray) -> FloatArray:
    """Return (...) probabilities that values are right, -1 if there is none.

    Parameters
    ----------
    kinds
        (...) row of ``odds`` for each, -1 for none.
    features
        (..., K) features of the values.
    odds
        (kinds, (K + 1) (K + 2) / 2) weights of one, the features, and their pairwise products.
    """
    chance = np.full(kinds.shape, -1.0)
    for kind, weights in enumerate(odds):
        own = kinds == kind
        described = np.hstack([np.ones((np.count_nonzero(own), 1)), features[own]])
        square = np.zeros((described.shape[-1],) * 2)
        square[np.triu_indices(len(square))] = weights
        chance[own] = 1.0 / (1.0 + np.exp(-(described @ square * described).sum(axis=-1)))
    return chance


def beam_candidates(
    own: Float32Array,
    steady: Float32Array,
    other: Float32Array,
    replaced: Float32Array,
    source: ProvenanceArray,
    eps_share: float,
    crowd: int,
) -> tuple[NDArray[np.intp], FloatArray]:
    """Find candidate values for a lidar curve.

    Parameters
    ----------
    own, steady, other, eps_share, crowd
        As for `describe_beams`.
    replaced, source
        (N,) as from `fusion.repair.replace_readings`.

    Returns
    -------
    (2, N) row of `BEAM_ODDS`, -1 for none, and (2, N, 7) the value and its features. The first of the two is
    from the camera or replaces a reading, the second is the line across a hole.
    """
    hole = source == HOLE
    doubted = np.isnan(steady) | (source == FILLED) | (source == INTERPOLATED)
    value = np.where(hole, other, replaced)
    nothing = np.full_like(value, np.nan)
    ranges = np.stack(
        [describe_beams(own, steady, other, doubted, put, eps_share, crowd) for put in (value, nothing)]
    )
    kind = np.full(ranges.shape[:2], -1)
    kind[0] = np.select(
        [hole & np.isfinite(other), source == FILLED, source == INTERPOLATED, source == AVERAGED],
        [0, 2, 3, 4],
        -1,
    )
    kind[1, hole] = 1
    kind[np.isnan(ranges[..., 0])] = -1
    return kind, ranges


@kernel
def describe_beams(
    own: Float32Array,
    steady: Float32Array,
    other: Float32Array,
    doubted: BoolArray,
    value: Float32Array,
    eps_share: float,
    crowd: int,
) -> FloatArray:
    """Compute the features that show whether values inserted into a lidar curve are right.

    Parameters
    ----------
    own, steady, other
        (N,) the curve, ``nan`` invalid; interpolated from its neighbours; what the camera sees there.
    doubted
        (N,) holes, and replaced readings: they are no support for others.
    value
        (N,) inserted values; ``nan``: the line between the two ends of the gap.
    crowd
        Beams on either side in which holes are counted: glass loses many beams, and those that return passed
        through it. A gap whose ends are farther away gives no features.

    Returns
    -------
    (N, 7) the value, and its features: the logarithm of the width of the gap; the distance between its ends;
    the holes around; the distance of the camera's value to the line between the ends, 0 without one; the
    logarithm of the range; the distance of the value to the reading. Differences are logarithms over noise.
    ``nan`` without two ends.
    """
    count = own.size
    result = np.full((count, 7), np.nan)
    lost = np.zeros(count + 1, np.int64)
    for i in range(count):
        lost[i + 1] = lost[i] + np.isnan(own[i])
    for i in range(count):
        left, right = i - 1, i + 1
        while left >= 0 and doubted[left]:
            left -= 1
        while right < count and doubted[right]:
            right += 1
        if left < 0 or right >= count or max(i - left, right - i) > crowd:
            continue
        width = right - left - 1
        line = width + 1.0
        # A straight wall is almost a straight line in 1 / range.
        line /= (right - i) / steady[left] + (i - left) / steady[right]
        put_m = line if np.isnan(value[i]) else value[i]
        low, high = max(0, i - crowd), min(count, i + crowd + 1)
        around = lost[high] - lost[low] - lost[min(high, right)] + lost[max(low, left + 1)]
        result[i, 0], result[i, 1] = put_m, math.log(width)
        result[i, 2] = over_noise(steady[left] - steady[right], line, eps_share)
        result[i, 3] = math.log(1.0 + around)
        result[i, 4] = 0.0 if np.isnan(other[i]) else over_noise(other[i] - line, line, eps_share)
        result[i, 5] = math.log(put_m)
        result[i, 6] = 0.0 if np.isnan(own[i]) else over_noise(own[i] - put_m, put_m, eps_share)
    return result


@kernel
def over_noise(apart_m: float, range_m: float, eps_share: float) -> float:
    """Return the logarithm of a difference divided by the noise."""
    return math.log(1.0 + abs(apart_m) / (SLACK_M + eps_share * range_m))
