# mypy: allow-untyped-decorators
"""The decisions on single readings: what is a hole, a burr or a real difference, and what takes its place."""

from __future__ import annotations

import math
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import NDArray

from fusion.curves import Float32Array, IntArray


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
        # Two in a row may be what is seen past an edge, and so may the last one before a jump.
        if max(own[i - 1] - steady[i - 1], own[i + 1] - steady[i + 1]) < 0.5 * jut and (
            max(own[i - 1], own[i + 1]) < own[i] and own[i] - min(own[i - 1], own[i + 1]) < 2.0 * jut
        ):
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
                if (sure and own[i] > other[i]) or _flies(own, i, first, last, eps_share):
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


@numba.njit(cache=True)
def look_at(
    depth: Float32Array,
    pixel: IntArray,
    range_of_depth: Float32Array,
    slopes: Float32Array,
    predicted: Float32Array,
    height_m: float,
    range_max_m: float,
) -> tuple[IntArray, Float32Array, Float32Array]:
    """For every column of a panorama the pixel that looks at a predicted point of a given height.

    Returns
    -------
    (W,) flat pixel index, -1 where the point is outside the image; (W,) the range measured there, ``nan`` in
    a hole; (W,) by what a range is divided to be a depth.
    """
    columns = predicted.size
    at = np.full(columns, -1, np.int32)
    measured = np.full(columns, np.nan, np.float32)
    scale = np.full(columns, np.nan, np.float32)
    fall = slopes[0] - slopes[1]
    for col in range(columns):
        if np.isnan(predicted[col]):
            continue
        row = math.floor((slopes[0] - height_m / predicted[col]) / fall + 0.5)
        if 0 <= row < slopes.size and pixel[row, col] >= 0:
            at[col], scale[col] = pixel[row, col], range_of_depth[row, col]
            value = depth[at[col]]
            if 0.0 < value <= range_max_m:
                measured[col] = value * scale[col]
    return at, measured, scale


@numba.njit(cache=True)
def repair_columns(
    measured: Float32Array,
    predicted: Float32Array,
    raw: Float32Array,
    inside: NDArray[np.bool_],
    eps_share: float,
    samples: tuple[int, int, int],
    fill_holes: bool,
) -> ProvenanceArray:
    """Which columns of a depth curve to fill from the lidar: Xu2024 Eq. (6) and (8).

    A hole is filled unless what the camera sees on both sides of it is nearer than the lidar's surface: then
    something stands before it. A run of readings that disagree is the camera's fault only between columns
    that agree, and is a burr where it lies behind the lidar's surface and is short, or is of single readings
    that fly before it. All else is seen by the camera alone, and is kept; so is what any of the lidar's own
    readings nearby is near to.

    Parameters
    ----------
    measured, predicted
        (W,) ranges of the camera, and of the lidar's surfaces, carried to the camera.
    raw
        (W,) the lidar's single readings, carried as they are.
    inside
        (W,) where a prediction falls into the image.
    samples
        Columns of the longest burr and of the longest flight, and how far aside a reading supports another.
    fill_holes
        False: burrs only.
    """
    count = measured.size
    source = np.zeros(count, np.uint8)
    agrees = np.zeros(count, np.bool_)
    for i in range(count):
        if np.isnan(measured[i]):
            source[i] = HOLE
        elif inside[i]:
            agrees[i] = abs(measured[i] - predicted[i]) <= eps_share * predicted[i]
    first = 0
    while first < count:
        if agrees[first] or not inside[first]:
            first += 1
            continue
        last = first
        while (
            last + 1 < count and not agrees[last + 1] and (inside[last + 1] or np.isnan(predicted[last + 1]))
        ):
            last += 1
        before, after = first > 0 and agrees[first - 1], last + 1 < count and agrees[last + 1]
        burrs = before and after
        for i in range(first, last + 1):
            if not inside[i]:
                continue
            if np.isnan(measured[i]):
                agreed = before or after
                if fill_holes and not _hidden(measured, predicted, i, first, last, agreed, eps_share):
                    source[i] = FILLED
            elif burrs and not _supported(measured[i], raw, i, samples[2], eps_share):
                short = last - first + 1 <= samples[0] and measured[i] > predicted[i]
                if short or _stands_alone(measured, i, samples[1], 0.5 * eps_share):
                    source[i] = FILLED
        first = last + 1
    return source


@numba.njit(cache=True)
def _supported(reading: float, raw: Float32Array, i: int, reach: int, eps_share: float) -> bool:
    """Whether the other sensor has a reading near this one, close by."""
    for k in range(max(0, i - reach), min(raw.size, i + reach + 1)):
        if abs(raw[k] - reading) <= eps_share * reading:
            return True
    return False


@numba.njit(cache=True)
def _stands_alone(measured: Float32Array, i: int, most: int, slack_share: float) -> bool:
    """Whether a reading, with no more than ``most`` in a row, hangs together with nothing beside it.

    What is beside it must hang together in turn: on a wall seen at a slant every reading stands alone.
    """
    low = high = i
    last = measured.size - 1
    while low > 0 and i - low <= most and _hang(measured[low - 1], measured[low], slack_share):
        low -= 1
    while high < last and high - i <= most and _hang(measured[high], measured[high + 1], slack_share):
        high += 1
    if high - low + 1 > most or low < 2 or high > last - 2:
        return False
    left_hole, right_hole = np.isnan(measured[low - 1]), np.isnan(measured[high + 1])
    left = left_hole or _hang(measured[low - 2], measured[low - 1], slack_share)
    right = right_hole or _hang(measured[high + 1], measured[high + 2], slack_share)
    return left and right and not (left_hole and right_hole)


@numba.njit(cache=True)
def _hang(near: float, far: float, slack_share: float) -> bool:
    """Whether two neighbours may be of one surface; false for a hole."""
    return abs(near - far) <= 0.01 + slack_share * min(near, far)


@numba.njit(cache=True)
def _hidden(
    measured: Float32Array,
    predicted: Float32Array,
    i: int,
    first: int,
    last: int,
    agreed: bool,
    eps_share: float,
) -> bool:
    """Whether the nearest readings on both sides of a hole stand before what the lidar sees there."""
    limit = predicted[i] * (1.0 - eps_share)
    left = right = False
    for k in range(i - 1, first - 1, -1):
        if not np.isnan(measured[k]):
            left = measured[k] < limit
            break
    for k in range(i + 1, last + 1):
        if not np.isnan(measured[k]):
            right = measured[k] < limit
            break
    return left and right and not agreed


@numba.njit(cache=True)
def repair_band(
    depth: Float32Array,
    source: ProvenanceArray,
    lookup: tuple[IntArray, Float32Array, Float32Array],
    predicted: Float32Array,
    raw: Float32Array,
    height_m: float,
    range_max_m: float,
    eps_share: float,
    samples: tuple[int, int, int],
    fill_holes: bool,
) -> None:
    """Repair the pixels of one height, in place.

    Parameters
    ----------
    depth, source
        The image and its provenance, flat.
    lookup
        Pixels, factors and slopes of the panorama.
    predicted, raw, samples, fill_holes
        As for `repair_columns`.
    """
    pixel, measured, scale = look_at(depth, lookup[0], lookup[1], lookup[2], predicted, height_m, range_max_m)
    kinds = repair_columns(measured, predicted, raw, pixel >= 0, eps_share, samples, fill_holes)
    for col in range(predicted.size):
        if kinds[col] == FILLED and pixel[col] >= 0:
            value = predicted[col] / scale[col]
            if value <= range_max_m:
                depth[pixel[col]], source[pixel[col]] = value, FILLED
