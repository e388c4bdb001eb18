# mypy: allow-untyped-decorators
"""The decisions on single beams: what is a hole, a burr or a real difference, and what takes its place."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fusion.curves import BESIDE, EDGE_M, NEAR_SAMPLES, SLACK_M, Float32Array
from fusion.kernel import kernel


class Provenance(IntEnum):
    """Where a sample comes from."""

    MEASURED = 0
    FILLED = 1  # from the other sensor
    INTERPOLATED = 2  # between good neighbours of the same curve
    HOLE = 3
    AVERAGED = 4  # both sensors agree: the mean of both, weighted by their noise


MEASURED, FILLED, INTERPOLATED, HOLE, AVERAGED = (np.uint8(kind) for kind in Provenance)

ProvenanceArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]

_SLANT_SHARE = 0.06  # what noise and slant add to a surface over a few readings
_FAR_M = 2.5  # farther out a lidar's noise grows faster than the range


def among_readings(own: Float32Array, around: int) -> BoolArray:
    """(N,) beams around which, so many on either side, there are at most two holes.

    Glass loses many beams, and those that come back went through it: there neither the neighbours nor the
    camera, which looks through as well, tell where it is.
    """
    holes = np.convolve(np.isnan(own), np.ones(2 * around + 1), "full")[around : around + own.size]
    return np.asarray(holes < 2.5)


@kernel
def repair_lidar(
    own: Float32Array,
    other: Float32Array,
    confident: BoolArray,
    eps_share: float,
    burr_samples: int,
    trust_other: float,
) -> tuple[Float32Array, ProvenanceArray]:
    """Repair a lidar curve by what the camera sees of it: Xu2024 Eq. (6) and (7).

    Parameters
    ----------
    own
        (N,) ``nan`` invalid.
    other
        (N,) the camera's, reprojected to the lidar's bearings, without what the camera itself contradicts.
    confident
        (N,) from `among_readings`: other holes stay.
    eps_share
        Residual as a share of the range beyond which a pair is noise.
    burr_samples
        Longest run of disagreeing readings that can be a burr: what is longer is consistent with itself,
        and the difference is real.
    trust_other
        Weight of the camera in the mean of two readings that agree, 0..1.

    Returns
    -------
    (N,) ranges and their `Provenance`.
    """
    count = own.size
    result = own.copy()
    source = np.zeros(count, np.uint8)
    for i in range(count):
        if np.isnan(own[i]):
            source[i] = HOLE
            if confident[i] and _continues(own, i, other[i]):
                result[i], source[i] = other[i], FILLED
        elif abs(own[i] - other[i]) <= min(eps_share * own[i], SLACK_M / max(trust_other, 1e-3)):
            result[i] = own[i] + trust_other * (other[i] - own[i])
            source[i] = AVERAGED
    _drop_bumps(own, other, eps_share, burr_samples, result, source)
    _drop_veil(own, other, eps_share, result, source)
    _bridge(result, other, confident, source, eps_share)
    _bridge_lone(result, confident, source, eps_share)
    return result, source


@kernel
def smooth_outliers(
    ranges: Float32Array, steady: Float32Array, source: ProvenanceArray, jut_share: float
) -> None:
    """Put readings behind their own surface back on to it, where the other sensor has no say.

    Readings before it are kept: they may be a thin thing.

    ``steady`` is the curve on the lines of its neighbours; only what is off by more than ``jut_share``
    of its range is replaced, so that a mean is never put in the place of a good reading. In place.
    """
    own = ranges.copy()
    for i in range(1, own.size - 1):
        jut = own[i] - steady[i]
        if source[i] != MEASURED or not jut > max(SLACK_M, jut_share * own[i]):
            continue
        # Two in a row may be what is seen past an edge, and so may the last one before a jump; where its
        # neighbours jut too there is a corner.
        alone = max(own[i - 1] - steady[i - 1], own[i + 1] - steady[i + 1]) < 0.5 * jut
        for j in range(max(0, i - BESIDE), min(own.size, i + BESIDE + 1)):
            alone = alone and (j == i or abs(own[j] - steady[i]) < 0.7 * jut + _SLANT_SHARE * own[i])
        if alone:
            ranges[i], source[i] = steady[i], INTERPOLATED


@kernel
def _drop_bumps(
    own: Float32Array,
    other: Float32Array,
    eps_share: float,
    burr_samples: int,
    result: Float32Array,
    source: ProvenanceArray,
) -> None:
    """Put short runs behind a surface, which is whole on both sides and for the other sensor, on to it."""
    first = 1
    while first < own.size - 1:
        if not _odd(own, other, first, eps_share):
            first += 1
            continue
        last = first
        while last + 1 < own.size and _odd(own, other, last + 1, eps_share):
            last += 1
        if last - first < burr_samples and last + 1 < own.size:
            left, right = own[first - 1], own[last + 1]
            one = abs(left - right) <= EDGE_M + 2.0 * eps_share * min(left, right)  # false for nan
            if one and (
                _agrees(own, other, first - 1, eps_share) or _agrees(own, other, last + 1, eps_share)
            ):
                for i in range(first, last + 1):
                    if own[i] > other[i] + _apart_m(own[i], eps_share):
                        result[i], source[i] = other[i], FILLED
        first = last + 1


@kernel
def _drop_veil(
    own: Float32Array,
    other: Float32Array,
    eps_share: float,
    result: Float32Array,
    source: ProvenanceArray,
) -> None:
    """Replace single readings that hang in the air between a nearer surface and a farther one; in place.

    A beam on an edge returns a mean of both. A thin thing looks the same where it stands before neither, so
    what replaces it must be certain: the other sensor sees none of it within two samples, and next to it both
    see one surface that reaches over this beam. A thing before both of its neighbours is never touched.
    """
    for i in range(2, own.size - 2):
        if source[i] != MEASURED or np.isnan(other[i]) or not _hangs(own, i, _apart_m(own[i], eps_share)):
            continue
        if not _odd(own, other, i, eps_share):
            continue
        rim = SLACK_M + 2.0 * eps_share * other[i]
        left = abs(other[i - 1] - other[i]) <= rim
        right = abs(other[i + 1] - other[i]) <= rim
        confident = (left and _agrees(own, other, i - 1, eps_share)) or (
            right and _agrees(own, other, i + 1, eps_share)
        )
        if confident and left != right:
            confident = not _moved(own, other, i, -1 if left else 1, rim, eps_share)
        if confident:
            result[i], source[i] = other[i], FILLED


@kernel
def _apart_m(range_m: float, eps_share: float) -> float:
    """What two readings of one surface may differ by: a lidar's noise grows faster than the range far out."""
    return max(SLACK_M, eps_share * range_m * max(1.0, range_m / _FAR_M))


@kernel
def _hangs(own: Float32Array, i: int, slack_m: float) -> bool:
    """Whether there is a nearer and a farther reading within two beams, and none that is as far."""
    nearer = farther = False
    for j in range(i - 2, i + 3):
        if j == i:
            continue
        if abs(own[j] - own[i]) <= slack_m:
            return False
        nearer = nearer or own[j] < own[i]
        farther = farther or own[j] > own[i]
    return nearer and farther


@kernel
def _moved(
    own: Float32Array, other: Float32Array, i: int, inward: int, rim_m: float, eps_share: float
) -> bool:
    """Whether the other sensor sees a thin surface aside of where this one does: its rims tell nothing then.

    Sample i is its last on one side; ``inward`` is the step to the others.
    """
    j = i
    while 0 < j < own.size - 1 and abs(j - i) <= BESIDE and abs(other[j + inward] - other[j]) <= rim_m:
        j += inward
    if not (0 < j < own.size - 1 and abs(j - i) <= BESIDE):
        return False
    beyond = own[j + inward]
    return _agrees(own, other, j, eps_share) and abs(beyond - other[j]) <= 1.5 * eps_share * other[j]


@kernel
def _odd(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Both have a reading, and none of the other's nearby is where this one is."""
    if np.isnan(own[i]) or np.isnan(other[i]):
        return False
    for j in range(max(0, i - NEAR_SAMPLES), min(own.size, i + NEAR_SAMPLES + 1)):
        if abs(own[i] - other[j]) <= eps_share * own[i]:
            return False
    return True


@kernel
def _agrees(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Whether both have the same reading there."""
    return 0 <= i < own.size and abs(own[i] - other[i]) <= 1.5 * eps_share * own[i]


@kernel
def _continues(own: Float32Array, i: int, range_m: float) -> bool:
    """Whether the readings on both sides of a hole of one or two beams are about as far; false for nan."""
    if not 0 < i < own.size - 1:
        return False
    left = own[i - 1] if not np.isnan(own[i - 1]) else own[max(0, i - 2)]
    right = own[i + 1] if not np.isnan(own[i + 1]) else own[min(own.size - 1, i + 2)]
    return max(abs(left - range_m), abs(right - range_m)) <= _SLANT_SHARE * range_m


@kernel
def _bridge(
    result: Float32Array,
    other: Float32Array,
    confident: BoolArray,
    source: ProvenanceArray,
    eps_share: float,
) -> None:
    """Interpolate short gaps, which both have, between readings that both have, of one surface; in place."""
    before = -1
    for i in range(result.size):
        if source[i] == HOLE:
            continue
        confirmed = _agrees(result, other, i, eps_share) and _agrees(result, other, before, eps_share)
        if 0 <= before < i - 1 and confirmed and confident[i - 1]:
            slack = SLACK_M + eps_share * min(result[i], result[before])
            if abs(result[i] - result[before]) <= slack:
                for k in range(before + 1, i):
                    share = (k - before) / (i - before)
                    result[k] = 1.0 / ((1.0 - share) / result[before] + share / result[i])
                    source[k] = INTERPOLATED
        before = i


@kernel
def _bridge_lone(
    result: Float32Array, confident: BoolArray, source: ProvenanceArray, eps_share: float
) -> None:
    """Interpolate single holes in both where the readings on either side lie on one line; in place."""
    for i in range(BESIDE, result.size - BESIDE):
        if source[i] != HOLE or not confident[i]:
            continue
        left, right = _line_at(result, source, i, -1, eps_share), _line_at(result, source, i, 1, eps_share)
        if abs(left - right) <= eps_share * min(left, right):  # false for nan
            result[i], source[i] = 2.0 / (1.0 / left + 1.0 / right), INTERPOLATED


@kernel
def _line_at(ranges: Float32Array, source: ProvenanceArray, i: int, step: int, eps_share: float) -> float:
    """Range at a sample of the line through those next to it on one side; ``nan`` where they make none."""
    n, sx, sy, sxx, sxy = float(BESIDE), 0.0, 0.0, 0.0, 0.0
    for k in range(1, BESIDE + 1):
        if source[i + k * step] == HOLE:
            return np.nan
        y = 1.0 / ranges[i + k * step]  # a straight wall is straight in one over the range
        sx, sy, sxx, sxy = sx + k, sy + y, sxx + k * k, sxy + k * y
    slope = (n * sxy - sx * sy) / (n * sxx - sx * sx)
    start = (sy - slope * sx) / n
    for k in range(1, BESIDE + 1):
        if not abs((start + slope * k) * ranges[i + k * step] - 1.0) <= eps_share:
            return np.nan
    return 1.0 / start if start > 0.0 else np.nan
