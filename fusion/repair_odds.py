# mypy: allow-untyped-decorators
"""How likely what a repair puts in is right: logistic regression on what can be measured around it.

``python tools/learn_repair_odds.py`` learns the weights, from simulated homes that no figure is told of.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fusion.curves import SLACK_M, BoolArray, Float32Array, FloatArray
from fusion.kernel import kernel
from fusion.repair import AVERAGED, FILLED, HOLE, INTERPOLATED, ProvenanceArray

# Of beams: what the camera puts into a hole, the line between its ends there, the camera in the place of a
# reading, the line there, the mean of both. Of pixels: into a hole, in the place of a reading.
# fmt: off
BEAM_ODDS = np.array([[ 4.810e+00, -2.920e+00,  2.500e-01, -1.590e+00, -8.400e-01,  1.290e+00,  0.000e+00,
   6.600e-01, -3.600e-01,  3.600e-01,  5.800e-01, -9.500e-01,  0.000e+00,  1.800e-01,
  -3.100e-01,  3.300e-01,  7.400e-01,  0.000e+00,  1.900e-01,  5.300e-01, -4.600e-01,
   0.000e+00, -1.150e+00, -2.300e-01,  0.000e+00, -1.490e+00,  0.000e+00,  0.000e+00],
 [ 6.610e+00, -2.190e+00, -1.550e+00, -2.120e+00, -6.000e-02, -3.120e+00,  0.000e+00,
   4.000e-01,  8.000e-02,  2.600e-01,  3.000e-01, -1.500e-01,  0.000e+00, -1.000e-02,
   4.200e-01,  1.000e-02, -2.000e-02,  0.000e+00,  1.400e-01, -8.000e-02, -5.000e-02,
   0.000e+00, -1.100e-01, -2.000e-01,  0.000e+00,  9.500e-01,  0.000e+00,  0.000e+00],
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
PIXEL_ODDS = np.array([[ 1.56, -4.4 , -0.14,  4.58,  4.47,  0.  , -1.7 , -1.99, -1.86, -3.04,  0.29,  1.28,
   0.07,  0.06,  0.  , -0.09,  0.52, -1.07, -0.51, -0.2 ,  0.35,  1.58,  0.  ,  0.06,
  -1.41,  1.43,  2.43,  0.04, -0.15,  0.  ,  0.09, -0.93,  0.56,  1.54, -0.14,  0.  ,
   0.19, -1.4 ,  0.51,  1.46,  0.  ,  0.  ,  0.  ,  0.  ,  0.  ,  0.39,  0.27, -0.01,
   0.21, -1.22,  7.35, -1.99, -5.12,  1.66, -0.48],
 [ 1.14,  1.67, -0.94,  0.56, -1.81, -3.19, -2.96, -0.28, -1.89, -2.07, -0.08,  1.05,
   0.01,  0.08,  0.07,  0.29, -0.57,  0.16,  0.77, -0.68,  0.35, -0.02, -0.93,  1.38,
  -0.81, -0.79,  1.88,  0.04, -0.17, -0.08,  0.05, -0.35,  0.21,  0.17, -0.18, -0.25,
   0.1 , -0.11, -0.3 , -0.68, -0.15, -0.12,  0.01,  0.34, -1.58,  0.5 , -0.84,  0.67,
  -0.36, -1.02,  6.42, -1.72, -3.88,  2.05, -0.59]])
# fmt: on


def probabilities(kinds: NDArray[np.intp], features: FloatArray, odds: FloatArray) -> FloatArray:
    """(...) that a value is right, -1 where there is none.

    Parameters
    ----------
    kinds
        (...) row of ``odds`` for each, -1 for none.
    features
        (..., K) what describes the values.
    odds
        (kinds, (K + 1) (K + 2) / 2) weights of one, the features, and their products by twos.
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
    """What could be put into a lidar curve.

    Parameters
    ----------
    own, steady, other, eps_share, crowd
        As for `describe_beams`.
    replaced, source
        (N,) as from `fusion.repair.replace_readings`.

    Returns
    -------
    (2, N) row of `BEAM_ODDS`, -1 for none, and (2, N, 7) the value and its features: of the camera or what
    replaces a reading, and of the line over a hole.
    """
    hole = source == HOLE
    doubted = np.isnan(steady) | (source == FILLED) | (source == INTERPOLATED)
    value = np.where(hole, other, replaced)
    nothing = np.full_like(value, np.nan)
    found = np.stack(
        [describe_beams(own, steady, other, doubted, put, eps_share, crowd) for put in (value, nothing)]
    )
    kind = np.full(found.shape[:2], -1)
    kind[0] = np.select(
        [hole & np.isfinite(other), source == FILLED, source == INTERPOLATED, source == AVERAGED],
        [0, 2, 3, 4],
        -1,
    )
    kind[1, hole] = 1
    kind[np.isnan(found[..., 0])] = -1
    return kind, found


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
    """What tells whether values are right that are put into a lidar curve.

    Parameters
    ----------
    own, steady, other
        (N,) the curve, ``nan`` invalid; on the lines of its neighbours; what the camera sees there.
    doubted
        (N,) holes, and readings that are replaced: they support nothing.
    value
        (N,) what is put in; ``nan``: the line between the two ends of the gap.
    crowd
        Beams to either side among which holes are counted: glass loses many, and what returns went through. A
        gap whose ends are farther away tells nothing.

    Returns
    -------
    (N, 7) the value, and its features: the logarithm of the width of the gap; how far its ends are apart;
    the holes around; how far the camera is off the line between the ends, 0 without one; the logarithm of the
    range; how far the value is off the reading. Differences are in logarithms of their share of the noise.
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
        # A straight wall is straight in one over the range.
        line /= (right - i) / steady[left] + (i - left) / steady[right]
        put = line if np.isnan(value[i]) else value[i]
        low, high = max(0, i - crowd), min(count, i + crowd + 1)
        around = lost[high] - lost[low] - lost[min(high, right)] + lost[max(low, left + 1)]
        result[i, 0], result[i, 1] = put, math.log(width)
        result[i, 2] = over_noise(steady[left] - steady[right], line, eps_share)
        result[i, 3] = math.log(1.0 + around)
        result[i, 4] = 0.0 if np.isnan(other[i]) else over_noise(other[i] - line, line, eps_share)
        result[i, 5] = math.log(put)
        result[i, 6] = 0.0 if np.isnan(own[i]) else over_noise(own[i] - put, put, eps_share)
    return result


@kernel
def over_noise(apart_m: float, range_m: float, eps_share: float) -> float:
    """A difference in logarithms of its share of the noise."""
    return math.log(1.0 + abs(apart_m) / (SLACK_M + eps_share * range_m))
