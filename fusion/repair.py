# mypy: allow-untyped-decorators
"""Decide for each beam whether it is a hole, an outlier or a real difference, and what replaces it."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from fusion.curves import BESIDE, EDGE_M, NEAR_SAMPLES, SLACK_M, Float32Array
from fusion.kernel import kernel


class Provenance(IntEnum):
    """Source of a sample.

    Examples
    --------
    >>> import fusion, numpy as np
    >>> source = np.array([0, 1, 1, 3], np.uint8)  # as returned by `fusion.denoise` for each beam
    >>> int((source == fusion.Provenance.FILLED).sum()), fusion.Provenance(3).name
    (2, 'HOLE')
    """

    MEASURED = 0
    FILLED = 1  # from the other sensor
    INTERPOLATED = 2  # between good neighbours of the same curve
    HOLE = 3
    AVERAGED = 4  # both sensors agree: the mean of both, weighted by their noise


MEASURED, FILLED, INTERPOLATED, HOLE, AVERAGED = (np.uint8(kind) for kind in Provenance)

ProvenanceArray = NDArray[np.uint8]
BoolArray = NDArray[np.bool_]

_SLANT_SHARE = 0.06  # noise and slant of a surface over a few readings


@kernel
def replace_readings(
    own: Float32Array, other: Float32Array, eps_share: float, burr_samples: int, trust_other: float
) -> tuple[Float32Array, ProvenanceArray]:
    """Replace readings of a lidar curve by those of the camera: Xu2024 Eq. (6) and (7).

    Parameters
    ----------
    own
        (N,) the lidar's ranges, ``nan`` for invalid.
    other
        (N,) the camera's, reprojected to the lidar's bearings, without its own contradictions.
    eps_share
        Residual, as a share of the range, above which a pair is noise.
    burr_samples
        Longest run of contradicting readings that can be an outlier (burr): a longer run is consistent with
        itself, and the difference is real.
    trust_other
        Weight of the camera in the mean of two readings that agree, 0..1.

    Returns
    -------
    (N,) ranges and their `Provenance`; holes remain.
    """
    count = own.size
    result = own.copy()
    source = np.zeros(count, np.uint8)
    for i in range(count):
        if np.isnan(own[i]):
            source[i] = HOLE
        elif abs(own[i] - other[i]) <= min(eps_share * own[i], SLACK_M / max(trust_other, 1e-3)):
            result[i] = own[i] + trust_other * (other[i] - own[i])
            source[i] = AVERAGED
    _drop_bumps(own, other, eps_share, burr_samples, result, source)
    _drop_veil(own, other, eps_share, result, source)
    return result, source


@kernel
def smooth_outliers(
    ranges: Float32Array, steady: Float32Array, source: ProvenanceArray, jut_share: float
) -> None:
    """Move readings behind their own surface back onto it, where the other sensor has no reading.

    Readings in front of it are kept: they may be a thin object.

    ``steady`` is the curve interpolated from its neighbours. Only readings off by more than ``jut_share`` of
    their range are replaced, so that a mean never replaces a good reading. Works in place.
    """
    own = ranges.copy()
    for i in range(1, own.size - 1):
        jut = own[i] - steady[i]
        if source[i] != MEASURED or not jut > max(SLACK_M, jut_share * own[i]):
            continue
        # Two in a row, or the last one before a jump, may be a surface behind an edge; if its neighbours
        # deviate too, it is a corner.
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
    """Move short runs behind a surface onto it, if it is whole on both sides and for the other sensor."""
    first = 1
    while first < own.size - 1:
        if not _is_outlier(own, other, first, eps_share):
            first += 1
            continue
        last = first
        while last + 1 < own.size and _is_outlier(own, other, last + 1, eps_share):
            last += 1
        if last - first < burr_samples and last + 1 < own.size:
            left, right = own[first - 1], own[last + 1]
            one_surface = abs(left - right) <= EDGE_M + 2.0 * eps_share * min(left, right)  # false for nan
            if one_surface and (
                _agrees(own, other, first - 1, eps_share) or _agrees(own, other, last + 1, eps_share)
            ):
                for i in range(first, last + 1):
                    if own[i] > other[i] + max(EDGE_M, eps_share * own[i]):
                        result[i], source[i] = other[i], FILLED
        first = last + 1


@kernel
def _drop_veil(
    own: Float32Array, other: Float32Array, eps_share: float, result: Float32Array, source: ProvenanceArray
) -> None:
    """Replace flying points, single readings between a nearer and a farther surface; in place.

    A beam on an edge returns a mean of both. A thin object can look the same, so a replacement must be
    certain: the other sensor does not see it within two samples, and next to it both sensors see one surface
    that extends over this beam. An object in front of both of its neighbours is never changed.
    """
    for i in range(2, own.size - 2):
        if source[i] != MEASURED or not _is_outlier(own, other, i, eps_share):
            continue
        if not _is_between(own, i, max(SLACK_M, eps_share * own[i])):
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
def _is_between(own: Float32Array, i: int, slack_m: float) -> bool:
    """Return whether there are a nearer and a farther reading within two beams, and none as far."""
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
    """Return whether the other sensor sees a thin surface shifted sideways: then its edges are not used.

    Sample i is its last on one side; ``inward`` is the step towards its other samples.
    """
    j = i
    while 0 < j < own.size - 1 and abs(j - i) <= BESIDE and abs(other[j + inward] - other[j]) <= rim_m:
        j += inward
    if not (0 < j < own.size - 1 and abs(j - i) <= BESIDE):
        return False
    beyond = own[j + inward]
    return _agrees(own, other, j, eps_share) and abs(beyond - other[j]) <= 1.5 * eps_share * other[j]


@kernel
def _is_outlier(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Return whether both have a reading, and no nearby one of the other agrees with this one."""
    if np.isnan(own[i]) or np.isnan(other[i]):
        return False
    for j in range(max(0, i - NEAR_SAMPLES), min(own.size, i + NEAR_SAMPLES + 1)):
        if abs(own[i] - other[j]) <= eps_share * own[i]:
            return False
    return True


@kernel
def _agrees(own: Float32Array, other: Float32Array, i: int, eps_share: float) -> bool:
    """Return whether both have the same reading there."""
    return 0 <= i < own.size and abs(own[i] - other[i]) <= 1.5 * eps_share * own[i]
