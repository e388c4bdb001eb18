# mypy: allow-untyped-decorators
"""The decisions on single beams: what is a hole, a burr or a real difference, and what takes its place."""

from __future__ import annotations

from enum import IntEnum

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.curves import Float32Array


class Provenance(IntEnum):
    """Where a sample comes from."""

    MEASURED = 0
    FILLED = 1  # from the other sensor
    INTERPOLATED = 2  # between good neighbours of the same curve
    HOLE = 3
    AVERAGED = 4  # both sensors agree: the mean of both, weighted by their noise


MEASURED, FILLED, INTERPOLATED, HOLE, AVERAGED = (np.uint8(kind) for kind in Provenance)

ProvenanceArray = NDArray[np.uint8]

_JUTS, _LEAST_JUT_M = 3.0, 0.05
_BESIDE, _BESIDE_SLOPE = 3, 0.01  # beams that must lie nearer to the surface, and what a slant adds
_NEAR_SAMPLES = 2  # readings of the other sensor this far aside may still be of the same surface


@numba.njit(cache=True)
def repair_lidar(
    own: Float32Array,
    other: Float32Array,
    eps_share: float,
    burr_samples: int,
    gap_samples: int,
    trust_other: float,
) -> tuple[Float32Array, ProvenanceArray]:
    """Repair a lidar curve by what the camera sees of it: Xu2024 Eq. (6) and (7).

    Parameters
    ----------
    own
        (N,) ``nan`` invalid.
    other
        (N,) the camera's, carried to the lidar's bearings, without what the camera itself contradicts.
    eps_share
        Residual as a share of the range beyond which a pair is noise.
    burr_samples
        Longest run of disagreeing readings that can be a burr: what is longer is consistent with itself,
        and the difference is real.
    gap_samples
        Longest gap in both that is interpolated.
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
            if not np.isnan(other[i]):
                result[i], source[i] = other[i], FILLED
        elif abs(own[i] - other[i]) <= eps_share * own[i]:
            result[i] = own[i] + trust_other * (other[i] - own[i])
            source[i] = AVERAGED
    _drop_burrs(own, other, eps_share, burr_samples, result, source)
    _bridge(result, other, source, gap_samples, eps_share)
    return result, source


@numba.njit(cache=True)
def calm(ranges: Float32Array, steady: Float32Array, source: ProvenanceArray, noise_share: float) -> None:
    """Put readings behind their own surface back on to it, where the other sensor has no say.

    Readings before it are kept: they may be a thin thing.

    ``steady`` is the curve on the lines of its neighbours; only what is off by more than `_JUTS` times the
    noise is replaced, so that a mean is never put in the place of a good reading. In place.
    """
    own = ranges.copy()
    for i in range(1, own.size - 1):
        jut = own[i] - steady[i]
        if source[i] != MEASURED or not jut > max(_LEAST_JUT_M, _JUTS * noise_share * own[i]):
            continue
        # Two in a row may be what is seen past an edge, and so may the last one before a jump; where its
        # neighbours jut too there is a corner.
        alone = max(own[i - 1] - steady[i - 1], own[i + 1] - steady[i + 1]) < 0.5 * jut
        for j in range(max(0, i - _BESIDE), min(own.size, i + _BESIDE + 1)):
            alone = alone and (j == i or abs(own[j] - steady[i]) < 0.7 * jut + _BESIDE_SLOPE * own[i])
        if alone:
            ranges[i], source[i] = steady[i], INTERPOLATED


@numba.njit(cache=True)
def _drop_burrs(
    own: Float32Array,
    other: Float32Array,
    eps_share: float,
    burr_samples: int,
    result: Float32Array,
    source: ProvenanceArray,
) -> None:
    """Replace what only this sensor says, and its own neighbours do not support; in place."""
    first = 0
    while first < own.size:
        if not _odd(own, other, first, eps_share):
            first += 1
            continue
        last = first
        while last + 1 < own.size and _odd(own, other, last + 1, eps_share):
            last += 1
        if last - first < burr_samples:
            held = first > 0 and last + 1 < own.size and not np.isnan(own[first - 1] + own[last + 1])
            sure = held and (
                _agrees(own, other, first - 1, eps_share) or _agrees(own, other, last + 1, eps_share)
            )
            for i in range(first, last + 1):
                behind = sure and own[i] > other[i] and _explained(own, i, first, last, eps_share)
                if behind or _flies(own, i, first, last, eps_share):
                    result[i], source[i] = other[i], FILLED
        first = last + 1


@numba.njit(cache=True)
def _odd(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Both have a reading, and none of the other's nearby is where this one is."""
    if np.isnan(own[i]) or np.isnan(other[i]):
        return False
    for j in range(max(0, i - _NEAR_SAMPLES), min(own.size, i + _NEAR_SAMPLES + 1)):
        if abs(own[i] - other[j]) <= eps_share * own[i]:
            return False
    return True


@numba.njit(cache=True)
def _explained(own: Float32Array, i: int, first: int, last: int, eps_share: float) -> bool:
    """Whether a reading behind the other sensor's can be a burr: light by a detour, or a flight at an edge.

    What lies behind both of its neighbours, and these are two surfaces, is seen through the gap between.
    """
    left, right = own[first - 1], own[last + 1]
    one = abs(left - right) <= 0.1 + 2.0 * eps_share * min(left, right)
    return one or own[i] <= max(left, right)


@numba.njit(cache=True)
def _agrees(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Whether both have the same reading there."""
    return 0 <= i < own.size and abs(own[i] - other[i]) <= 1.5 * eps_share * own[i]


@numba.njit(cache=True)
def _flies(own: Float32Array, i: int, first: int, last: int, eps_share: float) -> bool:
    """A reading nearer than the other sensor's is a burr only between a nearer thing and what is behind.

    The nearer thing keeps readings of its own then; a thin leg has none nearer beside it, and is kept.
    """
    slack = eps_share * own[i]
    nearer = farther = False
    for j in range(max(0, first - 2), min(own.size, last + 3)):
        if j < first or j > last:
            nearer = nearer or own[j] < own[i] - slack
            farther = farther or own[j] > own[i] + slack
    return nearer and farther


@numba.njit(cache=True)
def _bridge(
    result: Float32Array,
    other: Float32Array,
    source: ProvenanceArray,
    gap_samples: int,
    eps_share: float,
) -> None:
    """Interpolate short gaps, which both have, between readings that both have, of one surface; in place."""
    before = -1
    for i in range(result.size):
        if source[i] == HOLE:
            continue
        confirmed = _agrees(result, other, i, eps_share) and _agrees(result, other, before, eps_share)
        if 0 <= before < i - 1 and i - before - 1 <= gap_samples and confirmed:
            slack = 0.03 + eps_share * min(result[i], result[before])
            if abs(result[i] - result[before]) <= slack:
                for k in range(before + 1, i):
                    share = (k - before) / (i - before)
                    result[k] = 1.0 / ((1.0 - share) / result[before] + share / result[i])
                    source[k] = INTERPOLATED
        before = i
